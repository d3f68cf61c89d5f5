"""SOG 2: Gaussians as lossless WebP pictures in a zip, a pixel each.

Reference: the SOG format, version 2, as PlayCanvas describes it.
"""

from __future__ import annotations

import io
import json
import zipfile
from math import ceil, sqrt
from pathlib import Path

import numpy as np
from PIL import Image

from pipeline.exports.gaussians import SH_0, Gaussians
from storage.errors import UnsupportedScan

_LARGEST_SIDE = 16380  # of a WebP, 16383, in whole fours
_ZIP_TIME = (1980, 1, 1, 0, 0, 0)


def write(path: Path, gaussians: Gaussians) -> float:
    """Write them in the scan's axes, against the origin that `meta.json` names; returns the largest error of a coordinate.

    Raises: UnsupportedScan for more of them than a picture has pixels.
    """
    side = 4 * ceil(sqrt(len(gaussians)) / 4)
    if side > _LARGEST_SIDE:
        raise UnsupportedScan("SOG", f"{len(gaussians):,} Gaussians", f"{_LARGEST_SIDE**2:,}", "SPZ and PLY hold more")
    logarithms = np.sign(gaussians.position) * np.log1p(np.abs(gaussians.position))
    low, high = logarithms.min(axis=0), logarithms.max(axis=0)
    cell = np.round((logarithms - low) / np.where(high > low, high - low, 1) * 65535).astype(np.uint16)
    scales, scale_book = _indexed(np.log(gaussians.sigma))
    opacity = np.full((len(gaussians), 1), round(255 * gaussians.opacity), np.uint8)
    pictures = {
        "means_l": _opaque((cell & 255).astype(np.uint8)),
        "means_u": _opaque((cell >> 8).astype(np.uint8)),
        "quats": _smallest_three(gaussians.rotation),
        "scales": _opaque(scales),
        "sh0": np.concatenate([np.round(255 * gaussians.color).astype(np.uint8), opacity], axis=1),
    }
    meta = {
        "version": 2,
        "asset": {"generator": "splatpress"},
        "count": len(gaussians),
        "origin": list(gaussians.origin),
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_book, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": ((np.arange(256) / 255 - 0.5) / SH_0).tolist(), "files": ["sh0.webp"]},
    }
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(zipfile.ZipInfo("meta.json", _ZIP_TIME), json.dumps(meta))
        for name, rows in pictures.items():
            archive.writestr(zipfile.ZipInfo(f"{name}.webp", _ZIP_TIME), _picture(rows, side))
    decoded = low + cell / 65535 * (high - low)
    return float(np.abs(np.sign(decoded) * np.expm1(np.abs(decoded)) - gaussians.position).max())


def _opaque(rows: np.ndarray) -> np.ndarray:
    return np.concatenate([rows, np.full((len(rows), 1), 255, np.uint8)], axis=1)


def _indexed(values: np.ndarray) -> tuple[np.ndarray, list[float]]:
    """The nearest of 256 even levels of each value, and the levels."""
    low, high = float(values.min()), float(values.max())
    index = np.round((values - low) / (high - low or 1.0) * 255).astype(np.uint8)
    return index, np.linspace(low, high, 256).tolist()


def _smallest_three(rotation: np.ndarray) -> np.ndarray:
    """(n, 4) uint8: the three smallest of w, x, y, z, in order, and 252 + the number of the largest."""
    q = rotation[:, [3, 0, 1, 2]]
    largest = np.abs(q).argmax(axis=1)
    q = q * np.where(np.take_along_axis(q, largest[:, None], axis=1) < 0, -1.0, 1.0)
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    three = np.round(255 * (np.take_along_axis(q, others, axis=1) * sqrt(0.5) + 0.5)).clip(0, 255)
    return np.column_stack([three, 252 + largest]).astype(np.uint8)


def _picture(rows: np.ndarray, side: int) -> bytes:
    pixels = np.zeros((side * side, 4), np.uint8)
    pixels[: len(rows)] = rows
    stream = io.BytesIO()
    Image.fromarray(pixels.reshape(side, side, 4)).save(stream, "WEBP", lossless=True, exact=True, quality=75, method=4)
    return stream.getvalue()
