"""Average colours relative to the box of their chunk, in as many bits as cells of a given size take.

As positions (pipeline/geometry/positions.py), but along luma and two axes of chroma, on which the colours of a chunk
lie close together, and with a bound on the size of a cell in place of a number of bits: a chunk of one material takes
few bits, one of all colours up to MOST_COLOR_BITS. Where noise of equal power is added everywhere, bits are spent where
they count (reverse water-filling: Cover and Thomas, Elements of Information Theory, section 10.3).

Colours are in 255ths of sRGB. Lengths on the axes have codes, STEPS_AN_OCTAVE an octave, so that extents take a byte.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from storage.packed.schema import CHUNK, COARSEST_COLOR_STEP, FINEST_COLOR_STEP, STEPS_AN_OCTAVE, color_bits

AXES = np.array([[1, 1, 1], [1, 0, -1], [1, -2, 1]]) / np.sqrt([[3], [2], [6]])  # luma, then chroma; orthonormal rows
LOW_STEPS = 32  # of a corner, a 255th
LEAST_OCTAVE = -6  # code 0 is 2^-6


@dataclass(frozen=True)
class ColorBoxes:
    """The boxes of consecutive chunks on AXES; 9 bytes a chunk."""

    low: np.ndarray  # (n_chunks, 3) int16, 32nds of a 255th
    size: np.ndarray  # (n_chunks, 3) uint8, codes of lengths
    step: int  # code of the largest cell allowed

    @property
    def bits(self) -> np.ndarray:  # (n_chunks, 3) int64
        return color_bits(self.size, self.step)


def length_of(code):
    """The length that a code, or each of an array of codes, stands for, in 255ths.

    >>> length_of(96), length_of(112)
    (1.0, 2.0)
    """
    return 2.0 ** (np.asarray(code) / STEPS_AN_OCTAVE + LEAST_OCTAVE)[()]


def step_for(length: float) -> int:
    """The code of the largest allowed length that is no larger.

    >>> step_for(2.0), length_of(step_for(0.1))
    (112, 0.5)
    """
    return int(
        np.clip(
            np.floor(STEPS_AN_OCTAVE * (np.log2(length) - LEAST_OCTAVE) + 1e-9), FINEST_COLOR_STEP, COARSEST_COLOR_STEP
        )
    )


def fit_color_boxes(color: np.ndarray, step: int) -> ColorBoxes:
    """Boxes around each run of CHUNK rows of `color` (n, 3) in 255ths."""
    on_axes, starts = _on_axes(color), np.arange(0, len(color), CHUNK)
    low = np.floor(np.minimum.reduceat(on_axes, starts, axis=0) * LOW_STEPS)
    extent = np.maximum.reduceat(on_axes, starts, axis=0) - low / LOW_STEPS
    size = np.ceil(STEPS_AN_OCTAVE * (np.log2(np.maximum(extent, length_of(0))) - LEAST_OCTAVE))
    return ColorBoxes(low.astype(np.int16), size.astype(np.uint8), step)


def encode_colors(color: np.ndarray, boxes: ColorBoxes) -> np.ndarray:
    """Cells (n,) uint32 of colours (n, 3) in 255ths, the first axis in the lowest bits.

    Guarantees: on each of the AXES the decoded colour lies within half a cell, so within half of the boxes' step, of
    the given one; no channel is further off than 0.85 steps.
    """
    chunk = np.arange(len(color)) // CHUNK
    bits, low, size = boxes.bits[chunk], boxes.low[chunk] / LOW_STEPS, length_of(boxes.size)[chunk]
    cells = np.left_shift(1, bits)
    cell = np.clip(np.floor((_on_axes(color) - low) / size * cells), 0, cells - 1).astype(np.int64)
    return (cell[:, 0] | cell[:, 1] << bits[:, 0] | cell[:, 2] << bits[:, 0] + bits[:, 1]).astype(np.uint32)


def decode_colors(code: np.ndarray, boxes: ColorBoxes) -> np.ndarray:
    """The middles of cells (n,) as colours (n, 3) float32 in 255ths, clamped to 0..255."""
    chunk, code = np.arange(len(code)) // CHUNK, code.astype(np.int64)
    bits = boxes.bits[chunk]
    shift = np.stack([np.zeros(len(code), np.int64), bits[:, 0], bits[:, 0] + bits[:, 1]], axis=1)
    cells = np.left_shift(1, bits)
    cell = (code[:, None] >> shift) & (cells - 1)
    on_axes = boxes.low[chunk] / LOW_STEPS + (cell + 0.5) * (length_of(boxes.size)[chunk] / cells)
    return np.clip(_off_axes(on_axes), 0, 255).astype(np.float32)


def _on_axes(color: np.ndarray) -> np.ndarray:
    """(n, 3) float64. Products one by one: a matrix product may round otherwise on other machines."""
    color = np.asarray(color, np.float64)
    return np.stack([color[:, 0] * a[0] + color[:, 1] * a[1] + color[:, 2] * a[2] for a in AXES], axis=1)


def _off_axes(on_axes: np.ndarray) -> np.ndarray:
    return np.stack([on_axes[:, 0] * a[0] + on_axes[:, 1] * a[1] + on_axes[:, 2] * a[2] for a in AXES.T], axis=1)
