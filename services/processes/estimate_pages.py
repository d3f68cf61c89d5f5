"""What the page file of a job would take: the pages of some photographs, scaled to all."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipeline.execution.stage import StageRecord
from pipeline.planning.settings import Settings
from pipeline.stages.pages.coded import PagesMade
from pipeline.stages.pages.photo_pages import PhotoPages
from pipeline.summaries import Photographs
from services.flow.pages import form_of, pages_stage
from services.flow.prepare import Prepared
from services.flow.run import Run
from storage.work import work

SAMPLE_PHOTOGRAPHS = 2


@dataclass(frozen=True)
class PagesEstimated:
    """Of all photographs, or maps of stations."""

    record: StageRecord[PagesMade]  # of the sample
    bytes: float
    seconds: float
    processor_seconds: float


def estimate_pages(run: Run, prepared: Prepared, settings: Settings, folder: Path) -> PagesEstimated | None:
    """What `make_pages_beside` would take; None where the plan has no pages. The sample's pages are made in `folder`."""
    stage = pages_stage(prepared, form_of(settings), SAMPLE_PHOTOGRAPHS)
    if stage is None:
        return None
    own = Run(folder, run.executor, run.progress)
    folder.mkdir(parents=True, exist_ok=True)
    record: StageRecord[PagesMade] = own.do(stage)  # type: ignore[arg-type]
    tasks = list(work.finished_tasks(record.folder).values())
    scale, n_tasks = 1.0, len(tasks)
    if isinstance(stage, PhotoPages):
        cameras = work.summary(stage.photos, Photographs).cameras
        n_tasks = len(cameras)
        scale = 3 * sum(c.width_px * c.height_px for c in cameras) / record.summary.raw_bytes
    busy = scale * sum(task.seconds for task in tasks)
    rounds = -(-n_tasks // run.executor.n_workers)
    return PagesEstimated(
        record,
        scale * record.summary.bytes,
        busy / n_tasks * rounds,
        scale * sum(task.processor_seconds for task in tasks),
    )
