"""Anti-aliased resampling: texels that cover more than a photo pixel are means of all that they cover.

Each splat has as many lookups as its own texels ask for (pipeline/texture/resample.py); where no splat's do, one lookup
a texel is all there is, and nobody counts. It has no stage of its own: the one that resamples is told.
"""

from __future__ import annotations

import numpy as np

from pipeline.effects.block import Block, Sources
from pipeline.effects.effect import Effect, Measured, Worth
from pipeline.texture.projection import homographies, is_in_front
from pipeline.texture.resample import lookups_a_texel

EVERY = 8  # splats of a block


def _measure_block(block: Block) -> dict:
    s = block.sources
    n, n_coarse = 0, 0
    rows = np.arange(0, len(block.centre), EVERY)
    for i, camera in enumerate(s.cameras):
        own = rows[block.camera[rows] == i]
        u, v, _ = block.frame
        h = homographies(camera, tuple(s.origin), block.centre[own], u[own], v[own], block.radius[own])
        found = lookups_a_texel(h[is_in_front(h)])
        n, n_coarse = n + len(found), n_coarse + int((found > 1).any(axis=1).sum())
    return {"n": n, "n_coarse": n_coarse}


def _conclude(sums: list[dict], sources: Sources) -> Measured:
    n = sum(s["n"] for s in sums)
    share = sum(s["n_coarse"] for s in sums) / n if n else 0.0
    return Measured(share, share)


EFFECT = Effect(
    name="antialiasing",
    title="Texels that cover several photo pixels are their mean",
    measures="share of splats that have a texel of more than one photo pixel",
    threshold=1e-4,
    reason="where no splat has one, one lookup a texel is what the mean comes to",
    worth=Worth("fountain_p11 and monstree: no splat of either has such a texel, so what it gives is not known"),
    measure_block=_measure_block,
    conclude=_conclude,
    order=30,
)
