"""PLY: points with normals, colours and sizes in the scan's own large numbers; and Gaussians as 3DGS trainers write them.

References: Turk, "The PLY polygon file format", 1994; the properties of Gaussians are those of the SIGGRAPH 2023 paper's program.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.exports.cloud import Cloud
from pipeline.exports.gaussians import Gaussians

_TYPES = {"<f8": "double", "<f4": "float", "|u1": "uchar"}
_POINT = np.dtype(
    [
        *((n, "<f8") for n in "xyz"),
        *((n, "<f4") for n in ("nx", "ny", "nz")),
        *((n, "u1") for n in ("red", "green", "blue")),
        ("radius", "<f4"),
    ]
)
_GAUSSIAN = np.dtype(
    [
        (n, "<f4")
        for n in (
            "x",
            "y",
            "z",
            "nx",
            "ny",
            "nz",
            "f_dc_0",
            "f_dc_1",
            "f_dc_2",
            "opacity",
            "scale_0",
            "scale_1",
            "scale_2",
            "rot_0",
            "rot_1",
            "rot_2",
            "rot_3",
        )
    ]
)


def write_points(path: Path, cloud: Cloud, comments: Sequence[str]) -> None:
    """Positions absolute, as double; unit normals; sRGB bytes; the radius of each in the scan's unit."""
    rows = np.zeros(len(cloud), _POINT)
    for axis, (name, normal, color) in enumerate(zip("xyz", ("nx", "ny", "nz"), ("red", "green", "blue"), strict=True)):
        rows[name] = cloud.position[:, axis] + cloud.origin[axis]
        rows[normal] = cloud.normal[:, axis]
        rows[color] = np.round(255 * cloud.color[:, axis])
    rows["radius"] = cloud.radius
    _write(path, rows, comments)


def write_gaussians(path: Path, gaussians: Gaussians, comments: Sequence[str]) -> None:
    """Positions against the origin, which a comment names: float32 does not hold large coordinates. Scales are logarithms, opacity a logit,
    quaternions w first; there are no harmonics beyond the constant one."""
    rows = np.zeros(len(gaussians), _GAUSSIAN)
    for axis, name in enumerate("xyz"):
        rows[name] = gaussians.position[:, axis]
        rows[f"f_dc_{axis}"] = gaussians.dc[:, axis]
        rows[f"scale_{axis}"] = np.log(gaussians.sigma[:, axis])
        rows[f"rot_{axis + 1}"] = gaussians.rotation[:, axis]
    rows["rot_0"] = gaussians.rotation[:, 3]
    rows["opacity"] = np.log(gaussians.opacity / (1 - gaussians.opacity))
    _write(path, rows, [f"origin {' '.join(map(repr, gaussians.origin))}", *comments])


def _write(path: Path, rows: np.ndarray, comments: Sequence[str]) -> None:
    properties = [f"property {_TYPES[rows.dtype[name].str]} {name}" for name in rows.dtype.names]
    said = ["comment " + " ".join(text.split()).encode("ascii", "replace").decode() for text in comments]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *said,
        f"element vertex {len(rows)}",
        *properties,
        "end_header",
        "",
    ]
    with open(path, "wb") as file:
        file.write("\n".join(header).encode())
        rows.tofile(file)
