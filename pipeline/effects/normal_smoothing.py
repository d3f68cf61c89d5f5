"""Smoothed normals under a lamp: blended across the splats of a pixel as colours are, where the normals of those
differ.

Only where a scene is to be relit. Without it each splat is lit by its own normal before it is blended, and no second
target is filled; where neighbours have nearly one normal that shows as much.
"""

from __future__ import annotations

import numpy as np

from pipeline.effects.block import Block, Sources
from pipeline.effects.effect import Effect, Measured, Worth
from pipeline.splats.pairs import pairs_within

BINS, WIDEST_DEGREES = 256, 90.0  # of the histogram of angles; splats are seen from either side
EVERY = 8  # splats of a block
DIFFUSE = 0.7  # of renderer.effects.relighting.lamp
LEAST_DEGREES = round(
    float(np.degrees(1 / (255 * DIFFUSE))), 2
)  # that change a level of 255, light falling flat on a surface


def angles(position: np.ndarray, normal: np.ndarray, radius: float | np.ndarray, every: int = EVERY) -> np.ndarray:
    """Degrees (flat) between the normal of every n-th splat and those of the splats whose centres lie on its disc."""
    rows = np.arange(0, len(position), every)
    at, other = pairs_within(position, rows, np.broadcast_to(radius, len(position))[rows])
    at, other = at[at != other], other[at != other]
    sine = np.linalg.norm(np.cross(normal[at], normal[other]), axis=1)
    return np.degrees(np.arctan2(sine, np.abs((normal[at] * normal[other]).sum(axis=1))))


def _measure_block(block: Block) -> dict:
    found = angles(block.centre, block.frame[2], block.radius)
    return {"histogram": np.histogram(found, BINS, (0, WIDEST_DEGREES))[0].tolist()}


def _conclude(sums: list[dict], sources: Sources) -> Measured:
    histogram = np.sum([s["histogram"] for s in sums], axis=0) if sums else np.zeros(BINS)
    running = np.concatenate([[0], np.cumsum(histogram)])
    if not running[-1]:
        return Measured(0.0)
    middle = float(np.interp(running[-1] / 2, running, np.linspace(0, WIDEST_DEGREES, BINS + 1)))
    beyond = float(histogram[np.linspace(0, WIDEST_DEGREES, BINS + 1)[:-1] >= LEAST_DEGREES].sum() / running[-1])
    return Measured(middle, beyond)


EFFECT = Effect(
    name="normal_smoothing",
    title="Under a lamp, the normals of splats that blend are blended too",
    measures="degrees between the normals of splats that overlap, median",
    threshold=LEAST_DEGREES,
    reason="a turn of less changes what a lamp lights by less than a level of 255, where it changes most",
    worth=Worth("fountain_p11, draft, 4 views of 1,024 px, llvmpipe", frame_share=0.06),
    measure_block=_measure_block,
    conclude=_conclude,
    needs="relighting",
    order=85,
)
