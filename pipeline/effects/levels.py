"""Coarser levels of the same splats: what a far view draws instead of them, where a scan has more than a picture has
pixels.

Levels are made before splats are (services/flow/prepare.py), for these are splats like others; here stands what
decides.
"""

from __future__ import annotations

from pipeline.effects.block import Sources
from pipeline.effects.effect import Effect, Measured, Worth
from pipeline.splats.coarser import level_sizes
from pipeline.summaries import Points
from storage.work import work

PICTURE = 1920 * 1080  # pixels
USUAL_LEVELS = 3  # a quarter, a sixteenth and a 64th of the splats


def measured_by(counts: tuple[int, ...]) -> Measured:
    """What a scan says that has so many splats a level, the finest last."""
    return Measured(counts[-1] / PICTURE, sum(counts[:-1]) / sum(counts), {"splats": list(counts)})


def possible_levels(n_splats: int, asked: int | None) -> tuple[int, ...]:
    """Splats of each level that a scan of so many can have, the finest last: of as many coarser ones as are asked
    for."""
    return level_sizes(n_splats, USUAL_LEVELS if asked is None else asked)[::-1]


def _conclude(sums: list[dict], sources: Sources) -> Measured:
    counts = work.summary(sources.partition, Points).levels or (sources.n_splats,)
    return measured_by(counts if len(counts) > 1 else possible_levels(counts[-1], None))


EFFECT = Effect(
    name="levels",
    title="Coarser levels of the splats for views from afar",
    measures="splats a pixel of a picture of 1920x1080 that shows the whole scan",
    threshold=1.0,
    reason="below it a picture of the whole draws no more splats than it has pixels",
    worth=Worth("fountain_p11, draft, 2 levels", seconds_a_million=15.0, bytes_a_splat=8.4),
    conclude=_conclude,
    order=6,
)
