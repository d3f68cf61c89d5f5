"""LAS 1.4 and LAZ of points, through laspy and lazrs: colours, and normals and sizes as extra dimensions.

Reference: ASPRS LAS 1.4 R15.
"""

from __future__ import annotations

import os
from pathlib import Path

import laspy
import numpy as np

from pipeline.exports.cloud import Cloud

POINT_FORMAT = 7  # the one of 1.4 with red, green and blue
_FINEST = 1e-6
_EXTRA = ("normal_x", "normal_y", "normal_z", "radius")


def write(path: Path, cloud: Cloud) -> float:
    """Write them, as LAZ where the path ends in .laz; returns the largest error of a coordinate, half a step of the integers."""
    low = np.floor(cloud.position.min(axis=0))
    extent = float((cloud.position.max(axis=0) - low).max())
    step = 10.0 ** np.ceil(np.log10(max(extent / (2**31 - 2), _FINEST)))
    header = laspy.LasHeader(version="1.4", point_format=POINT_FORMAT)
    header.generating_software, header.system_identifier, header.creation_date = "splatpress", "", None
    header.offsets, header.scales = low + np.array(cloud.origin), np.full(3, step)
    header.add_extra_dims([laspy.ExtraBytesParams(name, np.float32) for name in _EXTRA])
    las = laspy.LasData(header)
    las.x, las.y, las.z = (cloud.position + cloud.origin).T
    las.red, las.green, las.blue = np.round(65535 * cloud.color).astype(np.uint16).T
    las.return_number[:] = las.number_of_returns[:] = 1
    for name, values in zip(_EXTRA, (*cloud.normal.T, cloud.radius), strict=True):
        las[name] = values.astype(np.float32)
    with open(os.fspath(path), "wb") as stream:
        las.write(stream, do_compress=path.suffix == ".laz", laz_backend=laspy.LazBackend.Lazrs)
    return float(step / 2)
