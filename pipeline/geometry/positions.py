"""Positions in 24 bits, relative to the box of their chunk.

Paper: HPG 2021, section 3.5.1. The 24 bits are shared among the axes by the logarithm of the box's extents: one bit
after the other goes to the axis whose step is the largest, which for extents a, 2a, 4a gives 7, 8, 9.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from storage.packed.schema import CHUNK

POSITION_BITS = 24


@dataclass(frozen=True)
class Boxes:
    """The boxes of consecutive chunks, against the scan's origin; 28 bytes a chunk."""

    low: np.ndarray  # (n_chunks, 3) float32
    size: np.ndarray  # (n_chunks, 3) float32
    bits: np.ndarray  # (n_chunks, 3) uint8, each row sums to POSITION_BITS


def share_bits(size: np.ndarray) -> np.ndarray:
    """How many of the 24 bits each axis gets. `size` (n_chunks, 3); returns uint8 of the same shape."""
    step = size.astype(np.float64)
    bits = np.zeros(size.shape, np.uint8)
    row = np.arange(len(size))
    for _ in range(POSITION_BITS):
        axis = step.argmax(axis=1)
        bits[row, axis] += 1
        step[row, axis] /= 2
    return bits


def fit_boxes(position: np.ndarray) -> Boxes:
    """Tight boxes in float32 around each run of CHUNK rows. `position` (n, 3) float64, against the origin."""
    starts = np.arange(0, len(position), CHUNK)
    exact_low = np.minimum.reduceat(position, starts, axis=0)
    exact_high = np.maximum.reduceat(position, starts, axis=0)
    low = exact_low.astype(np.float32)
    low = np.where(low > exact_low, np.nextafter(low, np.float32(-np.inf)), low)
    size = (exact_high - low).astype(np.float32)
    size = np.where(low + size.astype(np.float64) < exact_high, np.nextafter(size, np.float32(np.inf)), size)
    return Boxes(low, size, share_bits(size))


def encode_positions(position: np.ndarray, boxes: Boxes) -> np.ndarray:
    """Cell indices, x in the lowest bits, then y, then z. `position` (n, 3) float64; returns (n,) uint32 below 2^24.

    Guarantees: the decoded position lies within half a cell of the given one on every axis.
    """
    chunk = np.arange(len(position)) // CHUNK
    bits = boxes.bits[chunk].astype(np.int64)
    cells = np.left_shift(1, bits)
    size = boxes.size[chunk].astype(np.float64)
    share = (position - boxes.low[chunk]) / np.where(size > 0, size, 1.0)
    cell = np.clip(np.floor(share * cells), 0, cells - 1).astype(np.int64)
    shift_y, shift_z = bits[:, 0], bits[:, 0] + bits[:, 1]
    return (cell[:, 0] | cell[:, 1] << shift_y | cell[:, 2] << shift_z).astype(np.uint32)


def decode_positions(code: np.ndarray, boxes: Boxes, chunk: np.ndarray | None = None) -> np.ndarray:
    """Cell centres against the origin, (n, 3) float64. `chunk` (n,) names each splat's box; by default i // CHUNK."""
    if chunk is None:
        chunk = np.arange(len(code)) // CHUNK
    code = code.astype(np.int64)
    bits = boxes.bits[chunk].astype(np.int64)
    shift = np.stack([np.zeros(len(code), np.int64), bits[:, 0], bits[:, 0] + bits[:, 1]], axis=1)
    cell = (code[:, None] >> shift) & (np.left_shift(1, bits) - 1)
    return boxes.low[chunk] + (cell + 0.5) * (boxes.size[chunk] / np.left_shift(1, bits).astype(np.float64))
