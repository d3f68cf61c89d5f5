"""Radii of splats in a few bits each, on a scale of logarithms between the smallest and the largest of their chunk.

The scale of a chunk is two bytes: steps of a sixteenth of an octave of the scan's radius. Codes round up, for a splat
that is too small leaves a hole, while one that is too large by a seventh of its chunk's range only overlaps more. In
boxes codes have three bits; over quadrics as many values as make steps of nearly one ratio
(storage.packed.schema.size_cells), and the smallest 15 % of a chunk's splats are all as large as the largest of them:
those alone would make the scale a third longer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from storage.packed.schema import CHUNK, ONE_SIZE, SIZE_STEPS_AN_OCTAVE, size_cells

BITS = 3  # with 2 a spruce is drawn 1.41 times as often as with exact sizes, with 3 1.14 times
# Of the median of its chunk: what a stray point's distance to its neighbours may add to the scale that its whole chunk
# shares. Airborne scans with water have real gaps of more: they lose 1 % of their surface, at twice as much 0.
MOST_MEDIANS = 4.0
SMALLEST = 0.15  # of a chunk's splats that have the lowest value, over quadrics
_ROUNDING = 1e-9  # of a code: sizes that are a code's own stay so


@dataclass(frozen=True)
class Scales:
    """Of each chunk."""

    step: np.ndarray  # (c, 2) uint8: of its smallest and of its largest size; `s` is 2^((s - ONE_SIZE) / 16) radii
    radius: float  # the scan's
    cells: np.ndarray  # (c,) uint8: how many values its codes have


def cells_of(step: np.ndarray, bits: int | None) -> np.ndarray:
    """How many values codes of so many bits have, (c,) uint8; over quadrics, where they have none of their own, as the
    scales `step` (c, 2) call for."""
    return size_cells(step) if bits is None else np.full(len(step), 2**bits, np.uint8)


def fit_scales(size: np.ndarray, radius: float, bits: int | None = BITS) -> Scales:
    """The scales of consecutive sizes (n,), which begin a chunk; positive and finite. `bits` of a code, None over
    quadrics."""
    octave = np.log2(_by_chunk(size) / radius)
    middle, most = np.median(octave, axis=1, keepdims=True), np.log2(MOST_MEDIANS)
    octave = np.clip(octave, middle - most, middle + most)
    low = np.floor(octave.min(axis=1) * SIZE_STEPS_AN_OCTAVE + _ROUNDING)
    if bits is None:
        lowest = np.quantile(octave, SMALLEST, axis=1, method="lower")
        low = np.maximum(low, np.ceil(lowest * SIZE_STEPS_AN_OCTAVE - _ROUNDING))
    high = np.ceil(octave.max(axis=1) * SIZE_STEPS_AN_OCTAVE - _ROUNDING)
    step = np.clip(np.stack([low, high], axis=1) + ONE_SIZE, 0, 255).astype(np.uint8)
    return Scales(step, radius, cells_of(step, bits))


def encode_sizes(size: np.ndarray, scales: Scales) -> np.ndarray:
    """Codes (n,) uint8 of consecutive sizes (n,), which begin a chunk.

    Guarantees: what is decoded is no smaller than the size, and no larger than it by more than one step of its chunk's
    scale, wherever the size lies within the scale; beyond it lies the scale's nearer end.
    """
    low, high = scales.step.astype(np.float64).T
    last = scales.cells.astype(np.float64) - 1
    place = np.log2(_by_chunk(size) / scales.radius) * SIZE_STEPS_AN_OCTAVE + ONE_SIZE - low[:, None]
    code = np.ceil(place * (last / np.maximum(high - low, 1))[:, None] - _ROUNDING)
    code[high <= low] = 0
    return np.clip(code, 0, last[:, None]).astype(np.uint8).ravel()[: len(size)]


def decode_sizes(code: np.ndarray, scales: Scales) -> np.ndarray:
    """Radii (n,) float64 of consecutive codes (n,), which begin a chunk."""
    chunk = np.arange(len(code)) // CHUNK
    low, high = scales.step.astype(np.float64)[chunk].T
    step = low + (high - low) * code / np.maximum(scales.cells.astype(np.float64) - 1, 1)[chunk]
    return scales.radius * 2.0 ** ((step - ONE_SIZE) / SIZE_STEPS_AN_OCTAVE)


def _by_chunk(size: np.ndarray) -> np.ndarray:
    """(c, CHUNK); the last chunk is filled up with its last size."""
    return np.pad(size, (0, -len(size) % CHUNK), mode="edge").reshape(-1, CHUNK)
