"""`pages`: the photographs of a scan, or those of a work folder, as one page file (docs/PAGES.md)."""

from __future__ import annotations

import re
from dataclasses import asdict
from pathlib import Path

from pipeline.execution.stage import Executor, Progress
from pipeline.readers.attributes.options import ReadOptions
from pipeline.stages.pages.coded import PageForm
from pipeline.stages.pages.photo_pages import PhotoPages
from pipeline.summaries import Photographs
from services.flow.beside import place_pages
from services.flow.points.read import ingest_of
from services.flow.run import Run
from storage.errors import InvalidScan
from storage.whole import aside
from storage.work import work as work_folder

INGEST, EXPOSURE = "ingest-", "exposure-"
STAGE_FOLDER = re.compile(rf"({INGEST}|{EXPOSURE})[0-9a-f]{{16}}")


def make_pages(
    source: Path,
    out: Path,
    form: PageForm,
    executor: Executor,
    progress: Progress,
    *,
    reading: ReadOptions = ReadOptions(),
    work: Path | None = None,
) -> dict:
    """Write the page file `out` of a scan's photographs as they were taken, or of a work folder's as its textures were
    sampled from them (in one light, where the plan has exposure on). Returns what it holds, and its `psnr_db`.

    `out` is there whole or not at all. Raises: InvalidScan for a scan without photographs, and for a work folder of
    none or of several.
    """
    with aside(out) as beside:
        of_work = _is_work_folder(source)
        run = Run(source if of_work else work or beside, executor, progress)
        photos = photos_of(source) if of_work else ingest_of(run, source, reading).folder
        if not work_folder.summary(photos, Photographs).cameras:
            raise InvalidScan(str(source), "no photograph", "a scan with photographs: pages are pieces of them")
        one_light = photos.name.startswith(EXPOSURE)
        made = run.do(PhotoPages(photos, form, one_light))
        place_pages(made.folder, out)
    return asdict(made.summary) | {"path": str(out), "seconds": made.made_seconds}


def _stage_folders(source: Path) -> list[Path]:
    if not source.is_dir():
        return []
    return sorted(f for f in source.iterdir() if STAGE_FOLDER.fullmatch(f.name) and work_folder.is_complete(f))


def _is_work_folder(source: Path) -> bool:
    return bool(_stage_folders(source))


def photos_of(source: Path) -> Path:
    """The folder of photographs of a work folder: in one light, where that was made. Raises: InvalidScan for several
    scans' photographs."""
    found = _stage_folders(source)
    for name in (EXPOSURE, INGEST):
        of_name = [folder for folder in found if folder.name.startswith(name)]
        if len(of_name) > 1:
            raise InvalidScan(
                str(source),
                f"photographs of {len(of_name)} scans ({', '.join(f.name for f in of_name)})",
                "a work folder of one scan",
            )
        if of_name:
            return of_name[0]
    raise AssertionError(source)
