"""Cliplines: splats at depth discontinuities end there, instead of hanging over an edge or showing what hides them.

HPG 2021, section 3.5.2 and Figure 4. Stored as 3 x 4 bits (pipeline/geometry/cliplines.py) of the splats that have one.
"""

from __future__ import annotations

from pathlib import Path

from pipeline.effects.block import Block, Sources
from pipeline.effects.cliplines.nearest import NearestPoints
from pipeline.effects.cliplines.stage import Cliplines, cliplines_of
from pipeline.effects.effect import Effect, Measured, Worth

EVERY = 8  # splats of a block are measured


def _survey(sources: Sources) -> NearestPoints | None:
    return NearestPoints(sources) if sources.cameras or sources.scan.stations else None


def _measure_block(block: Block) -> dict:
    nearest = block.surveys.get("cliplines")
    if nearest is None:
        return {"n": 0, "n_clipped": 0}
    n_clipped = int(cliplines_of(block, nearest, every=EVERY)[1].sum())
    return {"n": -(-len(block.centre) // EVERY), "n_clipped": n_clipped}


def _conclude(sums: list[dict], sources: Sources) -> Measured:
    n = sum(s["n"] for s in sums)
    share = sum(s["n_clipped"] for s in sums) / n if n else 0.0
    return Measured(share, share)


def _build(sources: Sources, outcome: dict, survey: Path | None) -> Cliplines | None:
    return None if survey is None else Cliplines(sources, survey)


EFFECT = Effect(
    name="cliplines",
    title="Splats at depth discontinuities end at a line",
    measures="share of splats whose disc reaches over an edge of its surface",
    threshold=0.005,
    reason="fountain_p11 gains 0.14 dB from 5 % of its splats: half a per cent is worth 0.01 dB",
    worth=Worth(
        "fountain_p11, draft, 4 views of 1024 px, a loaded machine",
        seconds_a_million=11,
        bytes_a_splat=1.5,
        frame_share=0.14,
        gain_db=0.14,
    ),
    measure_block=_measure_block,
    conclude=_conclude,
    survey=_survey,
    build=_build,
    order=10,
)
