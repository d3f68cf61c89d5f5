"""What a scan calls for: coarser levels and radii of their own first, for all that the plan of effects measures is of
such splats."""

from __future__ import annotations

from pathlib import Path

from pipeline.effects.block import Sources
from pipeline.effects.levels import measured_by as levels_measured
from pipeline.effects.plan.measure_effects import MeasureEffects
from pipeline.effects.plan.plan import EffectPlan, measured_effects, plan_effects, with_reason
from pipeline.effects.plan.registry import effects
from pipeline.effects.plan.request import AUTO, OFF, ON, parse_request
from pipeline.effects.relighting import UNLIT
from pipeline.effects.sizes import measured_by
from pipeline.summaries import SizesNeeded
from services.flow.run import Run
from storage.work import work


def calls_for_levels(counts: tuple[int, ...], request: str) -> bool:
    """Whether so many splats a level, the coarsest first, are worth it; the plan says the same."""
    known = {"levels": effects()["levels"]}
    return bool(plan_effects({"levels": levels_measured(counts)}, parse_request(request), known=known).enabled)


def calls_for_sizes(summary: SizesNeeded, request: str) -> bool:
    """Whether radii differ by so much; the plan says the same."""
    known = {"sizes": effects()["sizes"]}
    return bool(plan_effects({"sizes": measured_by(summary)}, parse_request(request), known=known).enabled)


def plan_scan(run: Run, sources: Sources, request: dict[str, str]) -> tuple[EffectPlan, dict[str, Path]]:
    """Measure the scan for every effect that the request leaves open, and plan; and what the surveys of effects
    made."""
    if unlit := sources.scan.is_albedo and request["relighting"] == AUTO:
        request = request | {"relighting": ON}  # colours without light in them show no shape
    if not sources.sizes or work.summary(sources.sizes, SizesNeeded).large_share is None:
        request = request | {"sizes": OFF}  # who fixed one radius asked for no other
    names = measured_effects(request)
    if not names:
        return plan_effects({}, request, sources.n_splats), {}
    stages = ((name, effects()[name].survey(sources)) for name in names)
    surveys = tuple((name, run.do(stage).folder) for name, stage in stages if stage is not None)
    plan = plan_effects(run.do(MeasureEffects(sources, names, surveys)).summary, request, sources.n_splats)
    return (with_reason(plan, "relighting", UNLIT) if unlit else plan), dict(surveys)
