"""What a job makes beside its packed file: every stage that the catalogue runs by itself, where the job calls for
it."""

from __future__ import annotations

import os
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path

from pipeline.execution.stage import StageRecord
from pipeline.planning.settings import Settings
from pipeline.stages.beside import Given, stages_beside
from pipeline.stages.pages.coded import FILE, PagesMade
from services.flow.prepare import Prepared, has_photographs
from services.flow.run import Run
from storage import place
from storage.whole import whole


@dataclass(frozen=True)
class Beside:
    """What the report says of it: of pages, and what every other stage found, by its name."""

    pages: PagesMade | None
    found: dict[str, dict]


def given_by(prepared: Prepared, settings: Settings) -> Given:
    """What stages beside the packed file are made of."""
    maps = prepared.maps
    return Given(
        settings,
        prepared.sources,
        prepared.effects,
        prepared.photos if has_photographs(prepared) else None,
        "exposure" in dict(prepared.built),
        maps.folder if maps else None,
        maps.log_gain if maps else (),
    )


def make_beside(run: Run, prepared: Prepared, settings: Settings, pages: Path) -> Beside:
    """Run them; `pages` is where a page file goes."""
    records: list[StageRecord] = [run.do(stage) for stage in stages_beside(given_by(prepared, settings))]
    paged = next((record for record in records if isinstance(record.summary, PagesMade)), None)
    if paged is not None:
        place_pages(paged.folder, pages)
    found = {record.name: asdict(record.summary) for record in records if record is not paged}
    return Beside(paged.summary if paged else None, found)


def place_pages(made: Path, out: Path) -> None:
    """The page file of a stage's folder under another name: a link where the disk allows it, else a copy."""
    with whole(out) as partial:
        try:
            os.link(made / FILE, partial)
        except OSError:
            shutil.copyfile(place.here(made / FILE), partial)
