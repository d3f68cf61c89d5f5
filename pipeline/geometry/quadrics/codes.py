"""Numbers of splats over quadrics, and the frames that they are in.

Cells have the side that the error asked for allows, and then are made as small as the whole bits of the number leave
room for.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from pipeline.geometry.quadrics.frames import LEAN_BITS, SLOPE_BITS, Frames, curved, leaning, sloped
from pipeline.geometry.quadrics.quaternions import axes_of
from pipeline.geometry.quadrics.surfaces import WHOLE, Surface, surface
from storage.packed.schema import (
    CHUNK,
    LEAST_NUMBER_BITS,
    MOST_FRAME_CELLS,
    MOST_NUMBER_BITS,
    curve_units,
    origin_quanta,
    steps_of,
)

MEAN_OF_CELL = 0.4803  # distance of a point in a cube of side 1 from its middle, on average
ERROR = 1 / 30  # of a radius: mean distance of a decoded position from its own, by default
NORMAL_ERROR = 0.32  # degrees: the same of normals; what 127 steps leave of normals that look all round
MOST_NORMALS, MOST_LOW = 256, 254  # along a coordinate, and where they begin at most
MOST_PLACES = 2.0**31  # cells of a chunk
TO_SPARE = 1.1  # numbers have half a bit to spare on average, which makes cells so much smaller: by three scans
MOST_ATTEMPTS = 400  # at cells whose numbers fit; the third nearly always does


def asked_steps(radii: np.ndarray, error: float) -> np.ndarray:
    """Sides (c,) of cells at which the splats of each chunk are off by `error` of their own radii (n,) on average."""
    first = np.arange(0, len(radii), CHUNK)
    inverse = np.add.reduceat(1 / radii, first) / np.minimum(CHUNK, len(radii) - first)
    return error / MEAN_OF_CELL / inverse


def encode_quadrics(
    position: np.ndarray,
    normal: np.ndarray,
    asked: np.ndarray,
    normal_error: float = NORMAL_ERROR,
    sizes: tuple[np.ndarray, np.ndarray] | None = None,
    unit: np.ndarray | None = None,
) -> tuple[np.ndarray, Frames]:
    """Numbers (n,) uint64 and the frames of chunks, of positions (n, 3) float64 against the origin, unit
    normals (n, 3), sides of cells (c,) as `asked_steps` makes them, and how far normals may be off, degrees; of `sizes`
    their codes (n,) and how many values these have in each chunk (c,); powers of two `unit` (c,) that origins are whole
    multiples of at least.

    Guarantees: the decoded position lies within half a cell of the given one along every axis of its frame; origins are
    whole multiples of `unit`, or of half the power of two below their cells where that is more; cells are at most 1.13
    as wide as asked where 47 bits, 2^31 cells, 4,096 along an axis and 2^-22 of a coordinate leave them so; normals are
    those of the best code on their chunk's map, whose mean error is the one asked for within 4 %, where 55 to 175 steps
    do, and 127 in chunks that look all round. A chunk depends on no other.
    """
    n, n_chunks = len(position), -(-len(position) // CHUNK)
    of_chunks = np.arange(n_chunks * CHUNK).reshape(n_chunks, CHUNK)
    rows = np.minimum(of_chunks, n - 1)  # the last splat fills up the last chunk
    code, values = sizes or (np.zeros(n, np.int64), np.ones(n_chunks, np.uint8))
    unit = np.zeros(n_chunks) if unit is None else unit
    piece = surface(position[rows], normal[rows], normal_error, code[rows].astype(np.int64), values, unit)
    least = np.maximum(_least_steps(piece), piece.smallest)
    step = _up(np.maximum(asked * TO_SPARE, least))
    frames, number, largest = _coded(piece, step)
    taken = np.log2(largest + 1.0)
    bits = np.ceil(taken).clip(LEAST_NUMBER_BITS, _most_bits(frames)).astype(np.int64)
    step = _up(np.maximum(steps_of(step) * np.exp2((taken - bits) / 3), least))
    pending = np.arange(n_chunks)
    for _ in range(MOST_ATTEMPTS):
        some, numbers, largest = _coded(piece.at(pending), step[pending])
        bits[pending] = np.minimum(bits[pending], _most_bits(some))
        fits = largest < 2.0 ** bits[pending]
        done = pending[fits]
        number[done] = numbers[fits]
        for field in fields(frames):
            getattr(frames, field.name)[done] = getattr(some, field.name)[fits]
        pending = pending[~fits]
        if not len(pending):
            frames.bits[:] = bits
            return number.reshape(-1)[:n].astype(np.uint64), frames
        step[pending] = _up(1.015 * steps_of(step[pending]))
    raise AssertionError(f"no frame of {len(pending)} chunks after {MOST_ATTEMPTS} attempts")


def _most_bits(frames: Frames) -> np.ndarray:
    """Of a number whose cells are below 2^32, (c,)."""
    normals = (frames.normal_cells.astype(np.int64) + 1).prod(axis=1) * frames.sizes
    return np.minimum(MOST_NUMBER_BITS, 31 + np.frexp(normals.astype(np.float64))[1])


def _up(step: np.ndarray) -> np.ndarray:
    """Steps (c,) as they are stored, uint16, none smaller than they were."""
    word = np.nextafter(step.astype(np.float32), np.float32(np.inf)).view(np.uint32)
    return ((word + np.uint32(0xFFFF)) >> np.uint32(16)).astype(np.uint16)


def _coded(piece: Surface, step: np.ndarray) -> tuple[Frames, np.ndarray, np.ndarray]:
    """Frames with cells of `step` (c,) uint16, the numbers (c, CHUNK) int64 in them, and the largest of each (c,).
    Where normals look all round they have the whole map, by itself."""
    frames = _positioned(piece, step)
    cell, half = _cells(piece.point, frames)
    low, many = _normal_range(half, piece.unfolded, frames)
    folded = ((many > MOST_NORMALS) | (np.abs(low) > MOST_LOW)).any(axis=1)
    frames.normal_slope[folded], frames.normal_lean[folded] = 0, 0
    codes = np.where((folded & (piece.grid >= WHOLE))[:, None, None], piece.normal, piece.unfolded)
    low, many = _normal_range(half, codes, frames)
    frames.normal_low[:], frames.normal_cells[:] = low, many - 1
    digit = _left(half, codes, frames) - low[:, None]
    cells = frames.cells.astype(np.int64)[:, None]
    place = (cell[..., 2] * cells[..., 1] + cell[..., 1]) * cells[..., 0] + cell[..., 0]
    number = (place * many[:, None, 1] + digit[..., 1]) * many[:, None, 0] + digit[..., 0]
    number = number * piece.sizes[:, None] + piece.size
    return frames, number, number.max(axis=1)


def _least_steps(piece: Surface) -> np.ndarray:
    """The side (c,) of the smallest cells of which the chunk's box has no more than MOST_PLACES, and MOST_FRAME_CELLS
    along U and V."""
    extent = piece.extent + np.sqrt(3) * piece.unit[:, None]
    largest = np.maximum(extent.max(axis=1), piece.smallest)
    low, high = np.full(len(largest), -32.0), np.full(len(largest), 1.0)
    for _ in range(20):
        middle = (low + high) / 2
        cells = np.floor(extent / (largest * np.exp2(middle))[:, None]) + 2
        fits = (cells.prod(axis=1) <= MOST_PLACES) & (cells[:, :2].max(axis=1) <= MOST_FRAME_CELLS)
        low, high = np.where(fits, low, middle), np.where(fits, middle, high)
    return largest * np.exp2(high)


def _positioned(piece: Surface, step: np.ndarray) -> Frames:
    """Frames with cells of `step` (c,) uint16; of normals they have the slopes. Origins are whole multiples of half the
    power of two below the step, or of the piece's unit where that is larger."""
    quantum = np.maximum(origin_quanta(step), piece.unit)
    below = np.sqrt(0.75) * quantum  # along the third axis; where the quadric is steep a cell's move is more
    frames = _at_corners(piece, step, quantum, below)
    outside = np.arange(len(step))
    for _ in range(MOST_ATTEMPTS):
        low = _heights(piece.point[outside], frames.at(outside)).min(axis=1)
        outside = outside[low < 0]
        if not len(outside):
            return frames
        below[outside] += (0.5 - low[low < 0]) * steps_of(step[outside])
        some = piece.at(outside)
        others = _at_corners(some, step[outside], quantum[outside], below[outside])
        for field in fields(frames):
            getattr(frames, field.name)[outside] = getattr(others, field.name)
    raise AssertionError(f"no origin of {len(outside)} chunks after {MOST_ATTEMPTS} attempts")


def _heights(point: np.ndarray, frames: Frames) -> np.ndarray:
    """Over the quadric in cells, (c, CHUNK)."""
    along, half = _along(point, frames)
    return along[..., 2] - curved(half, frames.curve[:, None], curve_units(frames.cells)[:, None])


def _at_corners(piece: Surface, step: np.ndarray, quantum: np.ndarray, below: np.ndarray) -> Frames:
    """Frames whose origins are multiples of `quantum` (c,), and at most half a diagonal of it above that far below the
    lowest splats: that diagonal along the first two axes, `below` (c,) along the third."""
    slack = np.sqrt(0.75) * quantum
    wide, flat = steps_of(step)[:, None], piece.along[..., :2]
    low = flat.min(axis=1) - slack[:, None]
    extent = np.ptp(flat, axis=1) + 2 * slack[:, None]
    cells = (np.floor(extent / wide) + 1).clip(1, MOST_FRAME_CELLS).astype(np.uint16)
    many, unit = cells.astype(np.int64)[:, None], curve_units(cells)[:, None]
    curve = np.rint(piece.quadric * wide / 4 / unit).clip(-127, 127).astype(np.int8)
    slope = np.rint(piece.plane * wide[..., None] / 2 * 2**SLOPE_BITS).clip(-127, 127).astype(np.int8)
    cell = np.floor((flat - low[:, None]) / wide[:, None]).clip(0, many - 1)
    height = piece.along[..., 2] / wide - curved(2 * cell + 1 - many, curve[:, None], unit)
    corner = np.concatenate([low, height.min(axis=1, keepdims=True) * wide - below[:, None]], axis=1)
    origin = piece.middle + np.einsum("ci,cij->cj", corner, axes_of(piece.turn))
    origin = np.rint(origin / quantum[:, None]) * quantum[:, None]
    two = np.zeros((len(step), 2))
    return Frames(
        origin,
        piece.turn.copy(),
        step.copy(),
        cells,
        curve,
        np.zeros(len(step), np.uint8),
        two.astype(np.int16),
        two.astype(np.uint8),
        slope.reshape(-1, 4),
        np.rint(piece.lean * 2**LEAN_BITS).clip(-127, 127).astype(np.int8),
        piece.grid.copy(),
        piece.sizes.copy(),
    )


def _along(point: np.ndarray, frames: Frames) -> tuple[np.ndarray, np.ndarray]:
    """Positions along the axes of frames as they are stored, in cells, (c, CHUNK, 3), and half cells (c, CHUNK, 2)."""
    along = np.einsum("cij,ckj->cik", point - frames.origin[:, None].astype(np.float64), axes_of(frames.turn))
    along /= steps_of(frames.step)[:, None, None]
    many = frames.cells.astype(np.int64)[:, None]
    return along, 2 * np.floor(along[..., :2]).clip(0, many - 1).astype(np.int64) + 1 - many


def _cells(point: np.ndarray, frames: Frames) -> tuple[np.ndarray, np.ndarray]:
    """Cells (c, CHUNK, 3) int64 and half cells (c, CHUNK, 2) of positions, in frames as they are stored."""
    along, half = _along(point, frames)
    flat = (half - 1 + frames.cells.astype(np.int64)[:, None]) >> 1
    height = along[..., 2] - curved(half, frames.curve[:, None], curve_units(frames.cells)[:, None])
    deep = np.floor(height).clip(0, 2.0**32).astype(np.int64)
    return np.concatenate([flat, deep[..., None]], axis=2), half


def _normal_range(half: np.ndarray, unfolded: np.ndarray, frames: Frames) -> tuple[np.ndarray, np.ndarray]:
    """The lowest steps (c, 2) and how many there are (c, 2), int64."""
    left = _left(half, unfolded, frames)
    low = left.min(axis=1)
    return low, left.max(axis=1) - low + 1


def _left(half: np.ndarray, codes: np.ndarray, frames: Frames) -> np.ndarray:
    """What octahedral codes (c, CHUNK, 2) are beside their chunk's planes, the second beside the first too, int64."""
    left = codes - sloped(half, frames.normal_slope[:, None])
    first = left[..., 0] - left[..., 0].min(axis=1, keepdims=True)
    return np.stack([left[..., 0], left[..., 1] - leaning(first, frames.normal_lean[:, None])], axis=2)
