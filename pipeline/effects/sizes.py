"""A size for each splat: where a scan's points lie closer together in some places than in others.

HPG 2021, section 5, names it: "encode splat size in a few bits". Sizes come before all else that knows how large a
splat is, so their stage runs, and is decided on, before splats are made (services/flow/prepare.py); here stands what
decides.
"""

from __future__ import annotations

from pipeline.effects.block import Sources
from pipeline.effects.effect import Effect, Measured, Worth
from pipeline.geometry.sizes import BITS
from pipeline.summaries import SizesNeeded
from storage.work import work


def measured_by(summary: SizesNeeded) -> Measured:
    """What the stage `sizes` says."""
    return Measured(summary.large_share, 1.0, {"bits": BITS})


def _conclude(sums: list[dict], sources: Sources) -> Measured:
    found = None if sources.sizes is None else work.summary(sources.sizes, SizesNeeded)
    return Measured(0.0) if found is None or found.large_share is None else measured_by(found)


EFFECT = Effect(
    name="sizes",
    title="Each splat has a radius of its own",
    measures="share of the surface whose points lie more than 1.5 times as far apart as one radius fills",
    threshold=0.05,
    reason="even scans have less from chance alone: a random plane 0.9 %, fountain_p11 thinned evenly 3.7 %",
    worth=Worth(
        "holes and pixels that show what lies behind: conference_room 4.5 % to 0.0 %, pump_e57 11.6 % to 0.1 %",
        bytes_a_splat=0.39,
    ),
    conclude=_conclude,
    order=5,
)
