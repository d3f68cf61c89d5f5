"""What the page file of a job would take: the pages of some photographs, scaled to all."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from pipeline.execution.stage import Stage, StageRecord
from pipeline.planning.settings import Settings
from pipeline.stages.pages import map_pages, photo_pages
from pipeline.stages.pages.coded import PagesMade
from pipeline.summaries import Photographs
from services.flow.beside import given_by
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
    """What the page file of a job would take; None where the plan has none. The sample's pages are made in `folder`."""
    given = given_by(prepared, settings)
    of_photos, of_maps = photo_pages.asked(given), map_pages.asked(given)
    stage: Stage[PagesMade] | None = replace(of_photos, most=SAMPLE_PHOTOGRAPHS) if of_photos else of_maps
    if stage is None:
        return None
    own = Run(folder, run.executor, run.progress)
    folder.mkdir(parents=True, exist_ok=True)
    record: StageRecord[PagesMade] = own.do(stage)
    tasks = list(work.finished_tasks(record.folder).values())
    scale, n_tasks = 1.0, len(tasks)
    if of_photos:
        cameras = work.summary(of_photos.photos, Photographs).cameras
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
