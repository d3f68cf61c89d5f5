"""How far behind the nearest surface splats still blend: as far as the scan's own noise throws them, not a constant.

HPG 2021, section 3.6.2, takes 2 to 5 cm at a radius of 2 cm: "to allow blending of splats close to the surface". Two
splats of one surface lie apart in depth by the noise of their points, and by what the surface bends between them; both
show in how far the neighbours of a splat lie off its plane.
"""

from __future__ import annotations

import numpy as np

from pipeline.effects.block import Block, Sources
from pipeline.effects.effect import Effect, Measured, Worth
from pipeline.splats.pairs import pairs_within

LEAST_RADII = 1.0  # the margin of a scan without noise: discs that overlap at a slant of 45 degrees still blend
OVERLAP_RADII = 2.0  # discs whose centres are nearer than this overlap; so no residual, and no margin, is beyond 2 or 4
QUANTILE = 0.95
BINS = 256  # of the histogram of residuals
EVERY = 8  # splats of a block: 2,048 neighbourhoods


def residuals(position: np.ndarray, normal: np.ndarray, radius: float | np.ndarray, every: int = EVERY) -> np.ndarray:
    """How far the neighbours of every n-th splat lie off its plane, flat, in radii: those whose discs overlap its
    own."""
    rows = np.arange(0, len(position), every)
    reach = np.broadcast_to(radius, len(position))
    at, other = pairs_within(position, rows, OVERLAP_RADII * reach[rows])
    at, other = at[at != other], other[at != other]
    return np.abs(((position[other] - position[at]) * normal[at]).sum(axis=1)) / reach[at]


def _measure_block(block: Block) -> dict:
    return {"histogram": histogram_of(residuals(block.centre, block.frame[2], block.radius))}


def histogram_of(off: np.ndarray) -> list[int]:
    """Distances in radii, counted in BINS bins up to OVERLAP_RADII; what is farther counts as the last."""
    return np.histogram(np.minimum(off, OVERLAP_RADII), BINS, (0, OVERLAP_RADII))[0].tolist()


def _conclude(sums: list[dict], sources: Sources) -> Measured:
    histogram = np.sum([s["histogram"] for s in sums], axis=0)
    running = np.cumsum(histogram)
    if running[-1] == 0:
        return Measured(0.0, 0.0, {"margin_radii": LEAST_RADII})
    off = float(np.interp(QUANTILE * running[-1], running, (np.arange(BINS) + 1) * OVERLAP_RADII / BINS))
    return Measured(off, 1.0, {"margin_radii": max(LEAST_RADII, 2 * off)})


EFFECT = Effect(
    name="depth_margin",
    title="Splats blend as far behind each other as the scan's noise throws them",
    measures="radii that 95 % of the neighbours of a splat lie off its plane at most",
    threshold=LEAST_RADII / 2,
    reason="twice the residual is the margin; below it the least margin, one radius, holds it all",
    worth=Worth("fountain_p11, draft, 4 views of 1024 px, a loaded machine", frame_share=0.15, gain_db=0.22),
    measure_block=_measure_block,
    conclude=_conclude,
    order=60,
)
