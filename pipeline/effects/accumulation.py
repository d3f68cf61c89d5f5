"""32-bit sums of colours: only where so many splats lie on top of each other that 16 bits would show.

The renderer finds out pixel by pixel and draws once more with wide sums where it must (renderer/splats/targets.py), and
looks for copies when it loads a scene (renderer/splats/stacks.py); a scan whose own surface already lies so thick is
drawn so from the start.
"""

from __future__ import annotations

import numpy as np

from pipeline.effects.block import Block, Sources
from pipeline.effects.effect import Effect, Measured, Worth
from pipeline.splats.pairs import pairs_within

EVERY = 32  # splats of a block
OVERDRAWN = 16.0  # weight of a pixel from which 16-bit sums may be off by 1/255, as in resolve.frag.glsl


def overdraw(position: np.ndarray, radius: float | np.ndarray, every: int = EVERY) -> np.ndarray:
    """The summed blending weights 1 - d^2 at the centres of every n-th splat; those about it count as large as
    itself."""
    rows = np.arange(0, len(position), every)
    reach = np.broadcast_to(radius, len(position))
    at, other = pairs_within(position, rows, reach[rows])
    weight = 1 - ((position[other] - position[at]) ** 2).sum(axis=1) / reach[at] ** 2
    return np.bincount(at // every, weight, minlength=len(rows))


def _measure_block(block: Block) -> dict:
    found = overdraw(block.centre, block.radius)
    return {"n": len(found), "n_overdrawn": int((found > OVERDRAWN).sum()), "most": float(np.quantile(found, 0.99))}


def _conclude(sums: list[dict], sources: Sources) -> Measured:
    n = sum(s["n"] for s in sums)
    return Measured(max((s["most"] for s in sums), default=0.0), sum(s["n_overdrawn"] for s in sums) / n if n else 0.0)


EFFECT = Effect(
    name="accumulation",
    title="Colours are added up in 32 bits a channel",
    measures="summed blending weights at a splat's centre, 99 % of the splats of the thickest block",
    threshold=OVERDRAWN,
    reason="from a weight of 16 on sums of 16 bits may be off by 1/255 (renderer/splats/targets.py)",
    worth=Worth("not measured"),
    measure_block=_measure_block,
    conclude=_conclude,
    order=70,
)
