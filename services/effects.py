"""What a scan calls for, without compressing it."""

from __future__ import annotations

import tempfile
from pathlib import Path

from pipeline.effects.request import parse_request
from pipeline.settings import Settings
from pipeline.stage import Executor, Progress
from services.workflow import Run, plan_scan, splats_of


def effects_of(scan: Path, settings: Settings, executor: Executor, progress: Progress, work: Path | None = None) -> list[dict]:
    """The rows of a scan's plan; the stages up to its splats are run for it, in `work` or thrown away."""
    with tempfile.TemporaryDirectory(prefix="splatpress-effects-") as folder:
        run = Run(work or Path(folder), executor, progress)
        return plan_scan(run, splats_of(run, scan, settings.radius).sources, parse_request(settings.effects))[0].to_json()
