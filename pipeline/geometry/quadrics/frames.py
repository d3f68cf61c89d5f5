"""The frames of chunks over quadrics, and what numbers in them decode to.

A chunk of 128 neighbours is a piece of a surface: most of its box is empty, and its normals follow its shape. So a
splat is a cell (i, j, k) along the frame's axes U, V and N, the third counted from the quadric over (i, j), and the
steps by which its octahedral normal differs from a plane over (i, j), which is what the slope of a quadric is. All five,
and the code of its size, one of s, are one number in mixed radix,

    number = ((((k n_j + j) n_i + i) m_b + b) m_a + a) s + size  <  2^bits,

so no bit is lost to rounding each up to powers of two. The numbers of a batch are sorted when they are packed
(storage/packed/quadrics.py).

Papers: HPG 2021, section 3.5.1 (chunks, boxes), 3.5.2 (octahedral normals); Meyer et al. 2010.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from pipeline.geometry.normals import octahedron_of
from pipeline.geometry.quadrics.quaternions import axes_of
from storage.packed.schema import (
    CHUNK,
    FRAMES,
    curve_units,
    frame_origins,
    normal_steps,
    origin_units,
    size_cells,
    steps_of,
)

SLOPE_BITS = 8  # slopes of normals are in 2^-8 steps a half cell
LEAN_BITS = 6


@dataclass(frozen=True)
class Frames:
    """The frames of consecutive chunks, against the scan's origin, in the order of storage.packed.schema.FRAMES; 32
    bytes a chunk with the scale of its sizes."""

    origin: np.ndarray  # (c, 3) float64: lowest corner of the cells
    turn: np.ndarray  # (c, 3) int8: quaternion x, y, z with w TURN_W, from the frame's axes to the file's
    step: np.ndarray  # (c,) uint16: side of a cell, the upper half of a float32
    cells: np.ndarray  # (c, 2) uint16, 1..MOST_FRAME_CELLS: how many along U and V
    curve: np.ndarray  # (c, 3) int8: curve_units of x x, x y and y y, with x = 2 i + 1 - n_i, y = 2 j + 1 - n_j
    bits: np.ndarray  # (c,) uint8: of a number
    normal_low: np.ndarray  # (c, 2) int16: octahedral coordinates at x = y = 0 of the steps (0, 0)
    normal_cells: np.ndarray  # (c, 2) uint8: how many steps along each coordinate, less 1
    normal_slope: (
        np.ndarray
    )  # (c, 4) int8: 2^-SLOPE_BITS a half cell, of the first coordinate along x and y, then the second
    normal_lean: np.ndarray  # (c,) int8: 2^-LEAN_BITS of the second coordinate a step of the first
    normal_grid: np.ndarray  # (c,) uint8: how fine the octahedral map is, see normal_steps
    sizes: np.ndarray  # (c,) uint8: values of codes of sizes, 1 where all are of one; size_scale tells them

    def at(self, rows: np.ndarray) -> Frames:
        """Those of some chunks."""
        return Frames(*(getattr(self, field.name)[rows] for field in fields(self)))


def named_frames(frames: Frames) -> dict[str, np.ndarray]:
    """By their names in a packed file, which tells sizes elsewhere; origins as they are."""
    return {name: getattr(frames, field.name) for name, field in zip(FRAMES, fields(frames)[:-1], strict=True)}


def arrays_of_frames(frames: Frames, box: np.ndarray) -> dict[str, np.ndarray]:
    """By their names in a packed file, with the box (c, 6) float32 of each chunk's group."""
    named = named_frames(frames)
    place = np.rint((frames.origin - box[:, :3]) / origin_units(box)[:, None])
    assert place.min(initial=0) >= 0 and place.max(initial=0) < 1 << 16
    return named | {"frame_origin": place.astype(np.uint16), "frame_box": box}


def frames_of_arrays(arrays: dict[str, np.ndarray]) -> Frames:
    """Of the arrays of a packed file."""
    first = arrays[FRAMES[0]]
    sizes = size_cells(arrays["size_scale"]) if "size_scale" in arrays else np.ones(len(first), np.uint8)
    named = arrays | {"frame_origin": frame_origins(arrays)}
    return Frames(*(*(named[name] for name in FRAMES), sizes))


def wrapped(code: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Octahedral coordinates (..., 2) int64 within twice the steps (...,) of their map that left it over an edge,
    brought back to where they come in."""
    a, b = code[..., 0], code[..., 1]
    over = np.abs(a) > steps
    a, b = np.where(over, 2 * steps * np.sign(a) - a, a), np.where(over, -b, b)
    over = np.abs(b) > steps
    return np.stack([np.where(over, -a, a), np.where(over, 2 * steps * np.sign(b) - b, b)], axis=-1)


def decode_quadrics(
    number: np.ndarray, frames: Frames, chunk: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, 3) float64 against the origin, and normals (n, 3) int16: points of octahedra, not of unit length.
    `chunk` (n,) names each splat's frame; by default i // CHUNK."""
    chunk = np.arange(len(number)) // CHUNK if chunk is None else chunk
    left, digits = number.astype(np.int64) // frames.sizes[chunk], []
    radix = (*(frames.normal_cells.astype(np.int64) + 1).T, *frames.cells.astype(np.int64).T)
    for base in radix:
        left, digit = np.divmod(left, base[chunk])
        digits.append(digit)
    cell = np.stack([*digits[2:], left], axis=1)
    half = 2 * cell[:, :2] + 1 - frames.cells[chunk].astype(np.int64)
    along = cell + 0.5
    along[:, 2] += curved(half, frames.curve[chunk], curve_units(frames.cells)[chunk])
    along *= steps_of(frames.step)[chunk, None]
    position = frames.origin[chunk] + np.einsum("ni,nij->nj", along, axes_of(frames.turn)[chunk])
    step = np.stack([digits[0], digits[1] + leaning(digits[0], frames.normal_lean[chunk])], axis=1)
    normal = step + frames.normal_low[chunk] + sloped(half, frames.normal_slope[chunk])
    steps = normal_steps(frames.normal_grid)[chunk]
    code = wrapped(normal.clip(-2 * steps[:, None], 2 * steps[:, None]), steps)
    return position, octahedron_of(code, steps).astype(np.int16)


def curved(half: np.ndarray, curve: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Height of the quadric in cells, at half cells (..., 2)."""
    a, b = half[..., 0].astype(np.float64), half[..., 1].astype(np.float64)
    return (curve[..., 0] * a * a + curve[..., 1] * a * b + curve[..., 2] * b * b) * unit


def leaning(step: np.ndarray, lean: np.ndarray) -> np.ndarray:
    """What is added to the second octahedral coordinate at steps of the first: whole numbers, as `sloped`."""
    return (lean.astype(np.int64) * step) >> LEAN_BITS


def sloped(half: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """What is added to octahedral coordinates at half cells (..., 2): whole numbers, so that shaders find the same."""
    slope = slope.astype(np.int64)
    a, b = half[..., 0], half[..., 1]
    first, second = slope[..., 0] * a + slope[..., 1] * b, slope[..., 2] * a + slope[..., 3] * b
    return np.stack([first >> SLOPE_BITS, second >> SLOPE_BITS], axis=-1)
