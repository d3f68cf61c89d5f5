"""SPZ 3: Gaussians of 20 bytes before gzip, planes of one attribute after the other.

Positions are 24-bit fixed point, sizes 1/16 of a natural logarithm, quaternions their three smallest parts in 10 bits each. By the format's
convention x is right, y up, z towards the viewer.

Reference: nianticlabs/spz, its description of the format.
"""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np

from pipeline.exports.gaussians import Gaussians

MAGIC, VERSION = 0x5053474E, 3
_COLOR_SCALE = 0.15
_MOST_BITS = 12  # after the point, as other writers have: a quarter of a millimetre, up to 2 km
_LEVEL = 6


def fractional_bits(position: np.ndarray) -> int:
    """Bits after the point: as many as leave room for the largest coordinate, at most 12."""
    largest = max(float(np.abs(position).max(initial=0.0)), 1e-9)
    return int(np.clip(np.floor(np.log2((2**23 - 1) / largest)), 0, _MOST_BITS))


def write(path: Path, gaussians: Gaussians) -> float:
    """Write them, in axes with y up; returns the largest error of a coordinate."""
    n, bits = len(gaussians), fractional_bits(gaussians.position)
    fixed = np.round(gaussians.position * 2.0**bits).astype(np.int64)
    planes = [
        np.ascontiguousarray(fixed & 0xFFFFFF, "<u4").view(np.uint8).reshape(n, 3, 4)[:, :, :3],
        np.full(n, round(255 * gaussians.opacity), np.uint8),
        _bytes(gaussians.dc * _COLOR_SCALE * 255 + 127.5),
        _bytes((np.log(gaussians.sigma) + 10) * 16),
        _smallest_three(gaussians.rotation).astype("<u4"),
    ]
    header = struct.pack("<3I4B", MAGIC, VERSION, n, 0, bits, 0, 0)
    with open(path, "wb") as file, gzip.GzipFile("", "wb", _LEVEL, file, mtime=0) as packed:
        packed.write(header)
        for plane in planes:
            packed.write(np.ascontiguousarray(plane).tobytes())
    return float(np.abs(fixed / 2.0**bits - gaussians.position).max())


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.round(values).clip(0, 255).astype(np.uint8)


def _smallest_three(rotation: np.ndarray) -> np.ndarray:
    """(n,) uint32: which of x, y, z, w is largest in the top two bits, then the others in order, each a sign and nine bits."""
    largest = np.abs(rotation).argmax(axis=1)
    q = rotation * np.where(np.take_along_axis(rotation, largest[:, None], axis=1) < 0, -1.0, 1.0)
    packed = largest.astype(np.uint64)
    for axis in range(4):
        field = (q[:, axis] < 0).astype(np.uint64) << np.uint64(9) | np.round(
            511 * np.abs(q[:, axis]) * np.sqrt(2)
        ).clip(0, 511).astype(np.uint64)
        packed = np.where(largest == axis, packed, packed << np.uint64(10) | field)
    return packed
