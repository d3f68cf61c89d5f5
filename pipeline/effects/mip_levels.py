"""Mip levels of the dictionary: only those that views of the scan reach.

A splat is drawn from the level that its size on the screen asks for (renderer/shaders/attribute.vert.glsl), or from the
two about it (level_blending.py).
So the pixels that splats cover in the photographs, in those scaled down, and in a picture of the whole scan, tell which
levels are ever looked up. A job may declare a farther viewer (`--view-distance`), or ask for all levels
(`mip_levels=on`).
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.effects.block import Block, Sources
from pipeline.effects.effect import Effect, Measured, Worth
from pipeline.splats.boxes import boxes_of
from storage.packed.schema import ATOM_SIZES, MIP_SIZES, Camera

ATOM_AREA = 128.0  # texels of the square one radius wide that a pixel each is level 0: that of attribute.vert.glsl
TO_COARSER = 0.45  # added to a level before it is rounded down, as there
LEAST_AREA_PX = 0.25  # of that square: the smallest of which splat_quad.glsl tells the level
SMALLEST_VIEW_PX = (
    1024  # longer side of the smallest pictures of a photograph's view that reports and measurements draw
)
ORBIT_FOCAL_PX, ORBIT_DISTANCE = (
    869.0,
    1.31,
)  # of pictures of the whole scan (renderer/splats/views.py), 720 px high; times its diagonal
RARE = 0.001  # of all looks at splats that may need a finer or a coarser level than there is: those at a glancing angle
LEAST_SPAN = 1.0  # levels: views that lie closer together look up one level, but where levels are blended
EVERY = 8  # splats of a block
BINS_A_LEVEL, DEEPEST = 16, len(MIP_SIZES) - 1


def levels_seen(camera: Camera, centre: np.ndarray, normal: np.ndarray, radius: float | np.ndarray) -> np.ndarray:
    """The level, from 0 for 32 texels on, that a camera looks splats up at: of `centre` (n, 3), absolute, and `normal`
    (n, 3); NaN behind it."""
    ray = centre - np.asarray(camera.centre)
    depth = ray @ np.asarray(camera.rotation)[2]
    depth = np.where(depth > 2 * radius, depth, np.nan)
    area = camera.fx_px * camera.fy_px * radius**2 * np.abs((ray * normal).sum(axis=1)) / depth**3
    return np.clip(0.5 * np.log2(ATOM_AREA / np.maximum(area, LEAST_AREA_PX)), 0, DEEPEST)


def needed(histogram: np.ndarray) -> tuple[float, float]:
    """The finest and the coarsest level that all but RARE looks of a histogram of levels reach on either side."""
    running = np.cumsum(histogram)
    if not running[-1]:
        return 0.0, float(DEEPEST)
    low = np.searchsorted(running, RARE * running[-1], side="right")
    high = np.searchsorted(running, (1 - RARE) * running[-1])
    return float(low / BINS_A_LEVEL), float(min((high + 1) / BINS_A_LEVEL, DEEPEST))


def stored_sizes(
    outcome: dict | None, asked_for: bool, view_distance: float | None, blended: bool = False
) -> tuple[int, int]:
    """Texels to a side of the finest level that atoms need, at most, and of the coarsest, at least: those that views
    look up; where they lie closer together than one level the nearest alone, and where nothing was measured the finest
    alone.

    >>> found = {"finest": 1.3, "coarsest": 2.4, "farthest": 4.0}
    >>> stored_sizes(found, False, None), stored_sizes(found, False, None, blended=True), stored_sizes(found, False,
    16.0) ((16, 8), (16, 4), (16, 2))
    >>> stored_sizes(found | {"coarsest": 2.0}, False, None)
    (8, 8)
    >>> stored_sizes(found, True, None), stored_sizes(None, False, None)
    ((32, 1), (32, 32))
    """
    if asked_for:
        return MIP_SIZES[0], MIP_SIZES[-1]
    if not outcome:
        return MIP_SIZES[0], MIP_SIZES[0]
    farther = (
        math.log2(max(1.0, view_distance / outcome["farthest"])) if view_distance and outcome["farthest"] > 0 else 0.0
    )
    low, high = outcome["finest"], outcome["coarsest"] + farther
    if not blended and high - low < LEAST_SPAN:
        low = high = _nearest((low + high) / 2)
    finest = max(MIP_SIZES[min(math.floor(low), DEEPEST)], ATOM_SIZES[-1])
    return finest, min(finest, MIP_SIZES[min(math.ceil(high) if blended else _nearest(high), DEEPEST)])


def _nearest(level: float) -> int:
    """As the renderer rounds."""
    return math.floor(level + TO_COARSER)


def _measure_block(block: Block) -> dict:
    s = block.sources
    histogram, farthest = np.zeros(DEEPEST * BINS_A_LEVEL, np.int64), 0.0
    rows = slice(None, None, EVERY)
    centre, normal, radius = block.centre[rows] + s.origin, block.frame[2][rows], block.radius[rows]
    for i, camera in enumerate(s.cameras):
        seen = block.seen[rows, i]
        level = levels_seen(camera, centre[seen], normal[seen], radius[seen])
        smaller = math.log2(max(1.0, max(camera.width_px, camera.height_px) / SMALLEST_VIEW_PX))
        for found in (level, np.minimum(level + smaller, DEEPEST)):
            histogram += np.histogram(found[np.isfinite(found)], len(histogram), (0, DEEPEST))[0]
        if seen.any():
            farthest = max(farthest, float(np.linalg.norm(centre[seen] - camera.centre, axis=1).max()))
    return {"histogram": histogram.tolist(), "farthest": farthest}


def _conclude(sums: list[dict], sources: Sources) -> Measured:
    if not (sources.cameras and sums):
        return Measured(0.0)
    finest, coarsest = needed(np.sum([s["histogram"] for s in sums], axis=0))
    coarsest = max(coarsest, _level_of_whole(sources))
    farthest = max(s["farthest"] for s in sums)
    return Measured(coarsest - finest, 1.0, {"finest": finest, "coarsest": coarsest, "farthest": farthest})


def _level_of_whole(sources: Sources) -> float:
    """The level that a picture of the whole scan looks its splats up at, face on."""
    low, high = boxes_of(sources.partition)
    box = high.max(axis=0) - low.min(axis=0)
    area = (ORBIT_FOCAL_PX * sources.radius / (ORBIT_DISTANCE * max(float(np.linalg.norm(box)), sources.radius))) ** 2
    return float(np.clip(0.5 * np.log2(ATOM_AREA / max(area, LEAST_AREA_PX)), 0, DEEPEST))


EFFECT = Effect(
    name="mip_levels",
    title="Atoms have levels for splats that look larger and smaller than each other",
    measures="mip levels from the finest to the coarsest that views reach, all but 0.1 % of splats either side",
    threshold=LEAST_SPAN,
    reason="views that lie closer together take one level, which is all that the file then has",
    worth=Worth("fountain_p11, draft, 4 views of 1,024 px", bytes_a_splat=0.1, gain_db=0.05),
    measure_block=_measure_block,
    conclude=_conclude,
    order=65,
)
