"""Average colours relative to the box of their chunk, in as many bits as cells of a given size take.

As positions (pipeline/geometry/positions.py), but along axes of the chunk's own (pipeline/texture/color_axes.py), on
which its colours lie close together, and with a bound on the size of a cell in place of a number of bits: a chunk of
one material takes few bits, one of all colours up to MOST_COLOR_BITS. Where noise of equal power is added everywhere,
bits are spent where they count (reverse water-filling: Cover and Thomas, Elements of Information Theory, section 10.3);
so a box leaves out colours up to half a cell beyond it where that takes more from its bits than it adds to the error.

Colours are in 255ths of sRGB. Lengths on the axes have codes, STEPS_AN_OCTAVE an octave, so that extents take a byte.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pipeline.texture.color_axes import fit_turns, turned, turned_back
from storage.packed.schema import (
    CHUNK,
    COARSEST_COLOR_STEP,
    COLOR_BOXES,
    FINEST_COLOR_STEP,
    STEPS_AN_OCTAVE,
    color_bits,
)

AXES = np.array([[1, 1, 1], [1, 0, -1], [1, -2, 1]]) / np.sqrt([[3], [2], [6]])  # luma, then chroma; orthonormal rows
LOW_STEPS = 32  # of a corner, a 255th
LEAST_OCTAVE = -6  # code 0 is 2^-6
# Of the step, squared: the error that takes as much as a bit. A bit more takes 3/4 of the step^2 / 12 that a colour in
# cells of the step is off, and that is what steps are chosen by.
BIT_WORTH = 1 / 16


@dataclass(frozen=True)
class ColorBoxes:
    """The boxes of consecutive chunks; 12 bytes a chunk."""

    low: np.ndarray  # (n_chunks, 3) int16, 32nds of a 255th
    size: np.ndarray  # (n_chunks, 3) uint8, codes of lengths
    turn: np.ndarray  # (n_chunks, 3) int8: quaternion x, y, z with w COLOR_TURN_W, from the box's axes to AXES
    step: int  # code of the largest cell allowed

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, np.ndarray], step: int) -> ColorBoxes:
        """Of those of a packed file."""
        low, size, turn = (arrays[name] for name in COLOR_BOXES)
        return cls(low, size, turn, step)

    def arrays(self) -> dict[str, np.ndarray]:
        """By their names in a packed file."""
        return dict(zip(COLOR_BOXES, (self.low, self.size, self.turn)))

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
    """Boxes around each run of CHUNK rows of `color` (n, 3) in 255ths, or of what is left of them without those at
    their edges."""
    on_axes, starts = _on_axes(color), np.arange(0, len(color), CHUNK)
    turn = np.zeros((len(starts), 3), np.int8)
    some = _box_around(on_axes, starts, step).bits.any(axis=1)  # boxes of one cell have no use for axes
    turn[some] = fit_turns(on_axes)[some]
    along = turned(on_axes, turn)
    whole = replace(_box_around(along, starts, step), turn=turn)
    less = _without_edges(along, starts, whole)
    reach = length_of(step) / 2
    lost, lost_more = (_mean_square(_off_middles(along, boxes), starts) for boxes in (whole, less))
    low, high = less.low / LOW_STEPS - reach, less.low / LOW_STEPS + length_of(less.size) + reach
    holds = (low <= np.minimum.reduceat(along, starts, axis=0)) & (np.maximum.reduceat(along, starts, axis=0) <= high)
    pays = holds & (whole.bits > 0) & (lost_more - lost < BIT_WORTH * length_of(step) ** 2)
    return replace(whole, low=np.where(pays, less.low, whole.low), size=np.where(pays, less.size, whole.size))


def encode_colors(color: np.ndarray, boxes: ColorBoxes) -> np.ndarray:
    """Cells (n,) uint32 of colours (n, 3) in 255ths, the first axis in the lowest bits.

    Guarantees: on each axis of its box the decoded colour lies within half of the boxes' step of the given one, or, of
    colours at the edges of their chunk's, within a step.
    """
    chunk = np.arange(len(color)) // CHUNK
    bits, cell = boxes.bits[chunk], _cells(turned(_on_axes(color), boxes.turn), boxes)
    return (cell[:, 0] | cell[:, 1] << bits[:, 0] | cell[:, 2] << bits[:, 0] + bits[:, 1]).astype(np.uint32)


def decode_colors(code: np.ndarray, boxes: ColorBoxes) -> np.ndarray:
    """The middles of cells (n,) as colours (n, 3) float32 in 255ths, clamped to 0..255."""
    chunk, code = np.arange(len(code)) // CHUNK, code.astype(np.int64)
    bits = boxes.bits[chunk]
    shift = np.stack([np.zeros(len(code), np.int64), bits[:, 0], bits[:, 0] + bits[:, 1]], axis=1)
    cells = np.left_shift(1, bits)
    cell = (code[:, None] >> shift) & (cells - 1)
    return np.clip(_off_axes(turned_back(_middles(cell, boxes), boxes.turn)), 0, 255).astype(np.float32)


def _box_around(along: np.ndarray, starts: np.ndarray, step: int) -> ColorBoxes:
    low = np.floor(np.minimum.reduceat(along, starts, axis=0) * LOW_STEPS)
    extent = np.maximum.reduceat(along, starts, axis=0) - low / LOW_STEPS
    size = np.ceil(STEPS_AN_OCTAVE * (np.log2(np.maximum(extent, length_of(0))) - LEAST_OCTAVE))
    return ColorBoxes(low.astype(np.int16), size.astype(np.uint8), np.zeros((len(starts), 3), np.int8), step)


def _without_edges(along: np.ndarray, starts: np.ndarray, boxes: ColorBoxes) -> ColorBoxes:
    """The largest boxes in the middle that take a bit less on each axis; of axes without bits any."""
    size = boxes.step + STEPS_AN_OCTAVE * np.maximum(boxes.bits - 1, 0)
    middle = (np.minimum.reduceat(along, starts, axis=0) + np.maximum.reduceat(along, starts, axis=0)) / 2
    low = np.rint((middle - length_of(size) / 2) * LOW_STEPS)
    return replace(boxes, low=low.astype(np.int16), size=size.astype(np.uint8))


def _cells(along: np.ndarray, boxes: ColorBoxes) -> np.ndarray:
    """Cells (n, 3) int64 of colours along the axes of their boxes."""
    chunk = np.arange(len(along)) // CHUNK
    low, size, cells = boxes.low[chunk] / LOW_STEPS, length_of(boxes.size)[chunk], np.left_shift(1, boxes.bits)[chunk]
    return np.clip(np.floor((along - low) / size * cells), 0, cells - 1).astype(np.int64)


def _middles(cell: np.ndarray, boxes: ColorBoxes) -> np.ndarray:
    chunk, side = np.arange(len(cell)) // CHUNK, length_of(boxes.size) / np.left_shift(1, boxes.bits)
    return boxes.low[chunk] / LOW_STEPS + (cell + 0.5) * side[chunk]


def _off_middles(along: np.ndarray, boxes: ColorBoxes) -> np.ndarray:
    return along - _middles(_cells(along, boxes), boxes)


def _mean_square(values: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Of each run of CHUNK rows (n, 3), by column."""
    return np.add.reduceat(values**2, starts, axis=0) / np.diff(np.append(starts, len(values)))[:, None]


def _on_axes(color: np.ndarray) -> np.ndarray:
    """(n, 3) float64. Products one by one: a matrix product may round otherwise on other machines."""
    color = np.asarray(color, np.float64)
    return np.stack([color[:, 0] * a[0] + color[:, 1] * a[1] + color[:, 2] * a[2] for a in AXES], axis=1)


def _off_axes(on_axes: np.ndarray) -> np.ndarray:
    return np.stack([on_axes[:, 0] * a[0] + on_axes[:, 1] * a[1] + on_axes[:, 2] * a[2] for a in AXES.T], axis=1)
