"""Small volumes that are known: a ball in a frame, written in every format."""

from __future__ import annotations

import bz2
import gzip
from pathlib import Path

import numpy as np

RAMP = np.arange(4 * 5 * 6, dtype=np.int16).reshape(6, 5, 4) - 50  # (n_k, n_j, n_i), every voxel another value


def ball(shape=(24, 22, 20), spacing=(1.0, 1.0, 1.0), radius: float = 7.0, inside: float = 100.0) -> np.ndarray:
    """Voxels (n_k, n_j, n_i) of a ball about the middle, of `radius` in units of length: values fall linearly through
    inside / 2 on it, by 10 a unit."""
    k, j, i = np.indices(shape[::-1], dtype=np.float64)
    far = np.sqrt(sum(((x - (n - 1) / 2) * s) ** 2 for x, n, s in zip((i, j, k), shape, spacing)))
    return np.clip(inside / 2 + 10 * (radius - far), 0, inside)


def middle_of(shape, spacing) -> np.ndarray:
    return (np.array(shape) - 1) / 2 * spacing


def nrrd_header(voxels: np.ndarray, encoding: str = "raw", extra: str = "", endian: str = "little") -> bytes:
    names = {
        "u1": "uint8",
        "i1": "int8",
        "i2": "int16",
        "u2": "uint16",
        "i4": "int32",
        "f4": "float",
        "f8": "double",
        "i8": "int64",
    }
    sizes = " ".join(map(str, voxels.shape[::-1]))
    return (
        f"NRRD0004\n# a comment\ntype: {names[voxels.dtype.str[1:]]}\ndimension: {voxels.ndim}\nsizes: {sizes}\n"
        f"endian: {endian}\nencoding: {encoding}\n{extra}\n"
    ).encode()


def packed(data: bytes, encoding: str) -> bytes:
    return {"raw": lambda d: d, "gzip": gzip.compress, "bzip2": bz2.compress}[encoding](data)


def write_nrrd(path: Path, voxels: np.ndarray, encoding: str = "raw", extra: str = "", endian: str = "little") -> Path:
    data = voxels.astype(voxels.dtype.newbyteorder(">" if endian == "big" else "<")).tobytes()
    path.write_bytes(nrrd_header(voxels, encoding, extra, endian) + packed(data, encoding))
    return path


def read(volume) -> tuple[np.ndarray, list[str]]:
    """All voxels, and what was found wrong while reading them."""
    warnings: list[str] = []
    return np.stack(list(volume.slices(warnings.append))), warnings
