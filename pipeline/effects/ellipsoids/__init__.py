"""Ellipsoids, where a scan is thinner than its splats: ropes, wires, twigs, chains, small balls.

Paper: 2020, sections 3.1 (fit) and 3.2 (rendering, `renderer/shaders/ellipsoid.glsl`); which splats become one is the
question that its sections 5.3.1 and 6 leave open, and `decision.py` answers.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.effects.block import Block, Sources
from pipeline.effects.effect import Effect, Measured, Worth
from pipeline.effects.ellipsoids.classes import radius_classes
from pipeline.effects.ellipsoids.decision import CELLS_RADII, REACH_RADII, thin_splats
from pipeline.effects.ellipsoids.nearest import gather
from pipeline.effects.ellipsoids.neighbourhoods import Around
from pipeline.effects.ellipsoids.noise import BINS, histogram_of, noise_radii, thirds_of
from pipeline.effects.ellipsoids.stage import Ellipsoids
from pipeline.effects.ellipsoids.thinned import CELL_RADII, thinned
from pipeline.execution.stage import Stage

EVERY = 8  # splats of a measured block: 2,048 neighbourhoods


def _measure_block(block: Block) -> dict:
    """Neighbourhoods here end at the block's own splats: those at its rim, a few per cent, seem a little thinner."""
    histogram, found = np.zeros(BINS, np.int64), []
    for radius, rows in radius_classes(block.radius[::EVERY], block.sources.radius):
        point, around = (
            block.position[::EVERY][rows],
            Around(thinned(block.position, CELL_RADII * radius), CELLS_RADII * radius),
        )
        near = gather(point, around, REACH_RADII * radius)
        histogram += histogram_of(thirds_of(near) / radius)
        found.append((point, around, radius))
    noise = noise_radii(histogram)
    n_thin = sum(int(thin_splats(point, around, r, noise * r).sum()) for point, around, r in found)
    return {"n_thin": n_thin, "n": -(-len(block.position) // EVERY), "thirds": histogram.tolist()}


def _conclude(sums: list[dict], sources: Sources) -> Measured:
    share = sum(s["n_thin"] for s in sums) / max(1, sum(s["n"] for s in sums))
    thirds = np.sum([s["thirds"] for s in sums], axis=0) if sums else np.zeros(BINS, np.int64)
    return Measured(share, share, {"noise_radii": noise_radii(thirds)})


def _build(sources: Sources, outcome: dict, survey: Path | None) -> Stage:
    return Ellipsoids(sources.partition, sources.radius, outcome["noise_radii"], sources.used_sizes)


EFFECT = Effect(
    name="ellipsoids",
    title="Splats on what is thinner or rounder than a disc are ellipsoids",
    measures="share of splats that are slender or small, and that no plane with a clipline explains",
    threshold=0.018,
    reason="surfaces have less from noise and gaps alone: stanford_dragon 1.6 %, fountain_p11 1.4 %, which would gain 0.1 dB for a third of the "
    "time of a job",
    worth=Worth(
        "fountain_p11 (draft, 4 views of 1,024 px) for dB; pump_e57, 6 % of its splats, for frame time",
        bytes_a_splat=4.0,
        frame_share=0.07,
        gain_db=0.09,
    ),
    measure_block=_measure_block,
    conclude=_conclude,
    build=_build,
    order=20,
)
