"""What a scan calls for, without compressing it; and, by compressing it several times, what each effect is worth."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from pipeline.effects.plan.plan import EffectPlan
from pipeline.effects.plan.request import canonical_request, parse_request
from pipeline.execution.stage import Executor, Progress
from pipeline.planning.settings import Settings
from renderer.evaluate.variants import EffectsVariant, compare_variants
from renderer.files import write_json
from services.flow.asked import prepare_asked, splats_asked
from services.flow.code import code
from services.flow.pack import pack
from services.flow.points.called_for import plan_scan
from services.flow.prepare import has_photographs
from services.flow.run import Run
from storage.packed.packed import SUFFIX


def effects_of(
    scan: Path, settings: Settings, executor: Executor, progress: Progress, work: Path | None = None
) -> list[dict]:
    """The rows of a scan's plan; the stages up to its splats are run for it, in `work` or thrown away."""
    with _run(executor, progress, work) as run:
        return plan_scan(
            run,
            splats_asked(run, scan, settings).sources,
            parse_request(settings.asked_effects),
        )[0].to_json()


def worth_of_effects(
    scan: Path,
    settings: Settings,
    executor: Executor,
    progress: Progress,
    work: Path | None = None,
    out: Path | None = None,
) -> dict:
    """`rows`, the plan, and `variants`: the scan packed and drawn as planned, with all effects on, with none, and with
    each that is on alone off; what renderer.evaluate.variants measures of each, with the seconds that its stages took.
    With `out` there are pictures of where each differs most from the plan, and all of it as effects.json."""
    with _run(executor, progress, work) as run, tempfile.TemporaryDirectory(prefix="splatpress-variants-") as folder:
        plan: EffectPlan | None = None
        variants: list[EffectsVariant] = []
        seconds: list[float] = []
        requests = {"plan": settings.effects}
        while len(variants) < len(requests):
            name = list(requests)[len(variants)]
            before = len(run.records)
            asked = replace(settings, effects=canonical_request(requests[name]))
            prepared = prepare_asked(run, scan, asked, effects=asked.effects)
            coded = code(run, prepared, asked) if has_photographs(prepared) else None
            path = Path(folder) / f"{len(variants)}{SUFFIX}"
            pack(run, prepared, coded, asked, scan.stem, path)
            variants.append(EffectsVariant(name, path, prepared.photos))
            seconds.append(sum(record.made_seconds for record in run.records[before:]))
            if plan is None:
                plan = prepared.effects
                requests |= {"all on": "all=on", "all off": "all=off"}
                requests |= {f"without {e}": f"{settings.effects},{e}=off" for e in plan.enabled}
        rows = compare_variants(variants, out)
        found = {
            "rows": plan.to_json(),
            "variants": [row | {"stage_s": s} for row, s in zip(rows, seconds, strict=True)],
        }
        if out is not None:
            write_json(out / "effects.json", found)
        return found


@contextmanager
def _run(executor: Executor, progress: Progress, work: Path | None) -> Iterator[Run]:
    with tempfile.TemporaryDirectory(prefix="splatpress-effects-") as folder:
        yield Run(work or Path(folder), executor, progress)
