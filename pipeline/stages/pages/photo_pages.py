"""Photographs -> one page file: every mip level of each, cut into pages that are coded alone (2020, section 4.4.2)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipeline.effects.exposure.photographs import read_photo
from pipeline.stages.beside import Given
from pipeline.stages.pages.coded import PageForm, PagesMade, PictureCoded, code_picture, form_of, join_pages
from pipeline.summaries import Photographs
from storage.packed.schema import Camera
from storage.pages.file import PageHeader, scan_digest
from storage.pages.layout import PageLayout
from storage.work import work


@dataclass(frozen=True)
class PhotoPages:
    """A task a photograph: its pages, one after the other. `photos` is a folder of photographs, with their cameras in
    its summary. Makes coded.FILE."""

    photos: Path
    form: PageForm = PageForm()
    one_light: bool = False  # `photos` are those of the stage `exposure`
    most: int = 0  # photographs, evenly among all: a sample of what the others take; 0 for all
    name = "photo-pages"

    def init(self, folder: Path) -> int:
        work.parts(folder).mkdir(exist_ok=True)
        return len(self._chosen())

    def run(self, folder: Path, index: int) -> PictureCoded:
        photo = self._chosen()[index]
        return code_picture(folder, index, read_photo(self.photos, photo), self.form)

    def finalise(self, folder: Path, results: list[PictureCoded]) -> PagesMade:
        cameras = [self._cameras()[photo] for photo in self._chosen()]
        layout = PageLayout(tuple((c.width_px, c.height_px) for c in cameras), self.form.page_px)
        names = tuple(camera.name for camera in cameras)
        digest = scan_digest(cameras)
        header = PageHeader(names, layout, self.form.border_px, self.form.codec, digest, self.one_light)
        return join_pages(folder, header, results)

    def _chosen(self) -> list[int]:
        n = len(self._cameras())
        n_chosen = min(n, self.most) if self.most else n
        return [i * n // n_chosen for i in range(n_chosen)]

    def _cameras(self) -> list[Camera]:
        return list(work.summary(self.photos, Photographs).cameras)


def asked(given: Given) -> PhotoPages | None:
    """The photographs of a scan in pages, where the plan has these on."""
    if "pages" not in given.effects.enabled or given.photos is None:
        return None
    return PhotoPages(given.photos, form_of(given.settings), given.in_one_light)
