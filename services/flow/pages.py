"""The page file of a job, beside its packed file: photographs, or maps of stations, as its textures are of them."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from pipeline.execution.stage import StageRecord
from pipeline.planning.settings import Settings
from pipeline.stages.pages.coded import FILE, PageForm, PagesMade
from pipeline.stages.pages.map_pages import MapPages
from pipeline.stages.pages.photo_pages import PhotoPages
from services.flow.prepare import Prepared, has_photographs
from services.flow.run import Run
from storage import place
from storage.whole import whole


def form_of(settings: Settings) -> PageForm:
    """What the settings ask of pages."""
    return PageForm(settings.page_codec, quality=settings.page_quality)


def pages_stage(prepared: Prepared, form: PageForm, most: int = 0) -> PhotoPages | MapPages | None:
    """The stage that makes the pages of a scan, where the plan has them on and there is something to cut: its photographs, as the
    effect exposure left them, of these at most `most` where that is not 0; else maps of its stations."""
    if "pages" not in prepared.effects.enabled:
        return None
    if has_photographs(prepared):
        return PhotoPages(prepared.photos, form, "exposure" in dict(prepared.built), most)
    if prepared.maps is not None:
        return MapPages(prepared.maps.folder, prepared.maps.log_gain, form)
    return None


def make_pages_beside(run: Run, prepared: Prepared, settings: Settings, out: Path) -> StageRecord[PagesMade] | None:
    """The page file `out` of a job, where the plan has pages on; None where it has not."""
    stage = pages_stage(prepared, form_of(settings))
    if stage is None:
        return None
    made = run.do(stage)
    place_pages(made.folder, out)
    return made


def place_pages(made: Path, out: Path) -> None:
    """The page file of a stage's folder under another name: a link where the disk allows it, else a copy."""
    with whole(out) as partial:
        try:
            os.link(made / FILE, partial)
        except OSError:
            shutil.copyfile(place.here(made / FILE), partial)
