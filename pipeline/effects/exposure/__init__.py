"""Exposure compensation: no seams where a surface passes from one photograph to the next."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.effects.block import Block, Sources
from pipeline.effects.effect import Effect, Measured, Worth
from pipeline.effects.exposure.light import N_TERMS
from pipeline.effects.exposure.observe import observed
from pipeline.effects.exposure.solve import Observations, solve_fields, spread
from pipeline.effects.exposure.stage import Exposed
from pipeline.summaries import Photographs
from storage.errors import InvalidScan
from storage.work import work

LEAST_SHARE = 0.01  # of light: a photograph that changes by less counts as unchanged


def _measure_block(block: Block) -> dict:
    return observed(block) if len(block.sources.cameras) > 1 else {}


def _conclude(sums: list[dict], sources: Sources) -> Measured:
    """Fields are solved from half the splats and judged by the other half; then solved from all, from there on."""
    seen = _joined([s for s in sums if s])
    n_photos = len(sources.cameras)
    if n_photos < 2 or not len(seen.splat):
        return Measured(0.0, 0.0, {"log_gain": []})
    even = seen.splat % 2 == 0
    judged = seen.only(~even)
    of_half = solve_fields(seen.only(even), n_photos)
    before, after = spread(judged), spread(judged, of_half)
    fields = solve_fields(seen, n_photos, of_half)
    changed = np.abs(fields[:, :, 0]).max(axis=1) > LEAST_SHARE
    return Measured(
        before - after,
        float(changed.mean()),
        {"log_gain": fields.round(5).tolist(), "spread_before": before, "spread_after": after},
    )


def _joined(sums: list[dict]) -> Observations:
    def column(name: str, dtype) -> np.ndarray:
        return np.concatenate([np.asarray(s[name], dtype) for s in sums]) if sums else np.empty(0, dtype)

    first = np.concatenate([np.full(len(s["splat"]), i) for i, s in enumerate(sums)]) if sums else np.empty(0, np.int64)
    splat = first * (1 << 20) + column("splat", np.int64)
    return Observations(
        splat, column("photo", np.int64), column("x", float), column("y", float), column("light", float).reshape(-1, 3)
    )


def exposed(ingest: Path, outcome: dict) -> Exposed:
    """The stage that makes the photographs that a file with this outcome was textured from.

    Raises: InvalidScan where the outcome, which a file may claim, is none of this scan.
    """
    wanted = (len(work.summary(ingest, Photographs).cameras), 3, N_TERMS)
    try:
        fields = np.array(outcome["log_gain"], np.float64)
        if fields.shape != wanted or not np.isfinite(fields).all():
            raise ValueError(f"log_gain of shape {fields.shape}")
    except (KeyError, TypeError, ValueError) as error:
        raise InvalidScan(
            "effect exposure of the packed file", str(error), f"finite numbers of shape {wanted}"
        ) from error
    return Exposed(ingest, tuple(tuple(map(tuple, photo)) for photo in fields.tolist()))


def _build(sources: Sources, outcome: dict, survey: Path | None) -> Exposed | None:
    return exposed(sources.ingest, outcome) if outcome["log_gain"] else None


EFFECT = Effect(
    name="exposure",
    title="Photographs are brought to one exposure, white balance and vignette",
    measures="levels of 255 by which the median spread of a splat's colours across photographs falls",
    threshold=1.0,
    reason="a seam of one level of 255 is what rounding makes of equal photographs; less cannot be told from it",
    worth=Worth("fountain_p11, draft, 4 views of 1024 px, a loaded machine", seconds_a_million=38, gain_db=1.91),
    measure_block=_measure_block,
    conclude=_conclude,
    build=_build,
    order=20,
)
