"""Whether a scan calls for coarser levels, and for radii of their own, decided before the plan: all that it measures is of such splats."""

from __future__ import annotations

from pipeline.effects.levels import measured_by as levels_measured
from pipeline.effects.plan.plan import plan_effects
from pipeline.effects.plan.registry import effects
from pipeline.effects.plan.request import parse_request
from pipeline.effects.sizes import measured_by
from pipeline.summaries import SizesNeeded


def calls_for_levels(counts: tuple[int, ...], request: str) -> bool:
    """Whether so many splats a level, the coarsest first, are worth it; the plan says the same."""
    known = {"levels": effects()["levels"]}
    return bool(plan_effects({"levels": levels_measured(counts)}, parse_request(request), known=known).enabled)


def calls_for_sizes(summary: SizesNeeded, request: str) -> bool:
    """Whether radii differ by so much; the plan says the same."""
    known = {"sizes": effects()["sizes"]}
    return bool(plan_effects({"sizes": measured_by(summary)}, parse_request(request), known=known).enabled)
