"""Splats over quadrics, group by group: origins of frames count in their group's box, in 16 bits along each axis."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.quadrics.codes import NORMAL_ERROR, encode_quadrics
from pipeline.geometry.quadrics.frames import Frames, arrays_of_frames, named_frames
from storage.packed.batches import CHUNKS_PER_GROUP
from storage.packed.quadrics import frame_extents
from storage.packed.schema import origin_quanta, origin_units

_MOST_ATTEMPTS = 50  # at units that fit their boxes; the first nearly always does


def quadrics_of_groups(
    position: np.ndarray,
    normal: np.ndarray,
    asked: np.ndarray,
    normal_error: float = NORMAL_ERROR,
    sizes: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, Frames, dict[str, np.ndarray]]:
    """Numbers (n,) uint64 and frames as `encode_quadrics` makes them of splats that begin a group, and the frames'
    arrays by their names in a packed file, with `frame_box`.

    A box has 2^15 to 2^16 units along its longest side. Where that is more than half the power of two below a chunk's
    cells, as where a group has a far stray, its origin is a multiple of that, and its cells begin so much lower. A group
    depends on no other.
    """
    unit = np.zeros(len(asked))
    for _ in range(_MOST_ATTEMPTS):
        number, frames = encode_quadrics(position, normal, asked, normal_error, sizes, unit)
        box = _boxes(frames)
        needed = origin_units(box)
        if (needed <= np.maximum(origin_quanta(frames.step), unit)).all():
            return number, frames, arrays_of_frames(frames, box)
        unit = np.maximum(unit, needed)
    raise AssertionError(f"no unit of origins after {_MOST_ATTEMPTS} attempts")


def _boxes(frames: Frames) -> np.ndarray:
    """The box of each chunk's group, (c, 6) float32: low corners that are whole units, and high ones."""
    low, high = frame_extents(named_frames(frames), frames.sizes)
    first = np.arange(0, len(low), CHUNKS_PER_GROUP)
    low = np.minimum.reduceat(frames.origin + low, first)
    high = np.maximum.reduceat(frames.origin + high, first)
    upper = _rounded(high, np.inf)
    unit = np.zeros(len(low))
    for _ in range(_MOST_ATTEMPTS):
        whole = np.where(unit[:, None] > 0, np.floor(low / np.where(unit > 0, unit, 1)[:, None]) * unit[:, None], low)
        box = np.concatenate([_rounded(whole, -np.inf), upper], axis=1)
        found = origin_units(box)
        if (found <= unit).all():
            return np.repeat(box, CHUNKS_PER_GROUP, axis=0)[: len(frames.step)]
        unit = np.maximum(unit, found)
    raise AssertionError(f"no box of {len(low)} groups after {_MOST_ATTEMPTS} attempts")


def _rounded(corner: np.ndarray, towards: float) -> np.ndarray:
    """Corners (g, 3) as float32, on that side."""
    found = corner.astype(np.float32)
    off = found > corner if towards < 0 else found < corner
    return np.where(off, np.nextafter(found, np.float32(towards)), found)
