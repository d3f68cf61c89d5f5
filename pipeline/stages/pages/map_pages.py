"""Maps of what a laser scan's stations saw -> one page file, in the light that splats are textured in."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.maps.light import levels_with
from pipeline.maps.station_map import NOTHING, MapFrame
from pipeline.maps.stored import filled
from pipeline.stages.beside import Given
from pipeline.stages.maps.panoramas import read_map
from pipeline.stages.maps.resample_maps import Gains
from pipeline.stages.pages.coded import PageForm, PagesMade, PictureCoded, code_picture, form_of, join_pages
from pipeline.summaries import MapsDrawn
from storage.pages.file import PageHeader, stations_digest
from storage.pages.layout import PageLayout
from storage.work import work


@dataclass(frozen=True)
class MapPages:
    """A task a station that saw something: the pages of its map's colours, (h, 6 h) texels; what shows no surface takes
    after what is around it. Makes coded.FILE."""

    maps: Path  # as those of `Panoramas`
    log_gain: Gains  # of each station's light, by channel
    form: PageForm = PageForm()
    name = "map-pages"

    def init(self, folder: Path) -> int:
        work.parts(folder).mkdir(exist_ok=True)
        return len(self._frames())

    def run(self, folder: Path, index: int) -> PictureCoded:
        station = self._frames()[index][0]
        seen = read_map(self.maps, station)
        assert seen is not None
        levels = levels_with(self.log_gain[station])
        rgb = np.stack([np.rint(levels[:, k])[seen.color[..., k]] for k in range(3)], axis=-1).astype(np.uint8)
        return code_picture(folder, index, filled(rgb, seen.depth != NOTHING), self.form)

    def finalise(self, folder: Path, results: list[PictureCoded]) -> PagesMade:
        frames = self._frames()
        layout = PageLayout(tuple((6 * f.height_px, f.height_px) for _, f in frames), self.form.page_px)
        names = tuple(f"station {station}" for station, _ in frames)
        digest = stations_digest([frame.centre for _, frame in frames])
        one_light = any(gain for gains in self.log_gain for gain in gains)
        header = PageHeader(names, layout, self.form.border_px, self.form.codec, digest, one_light)
        return join_pages(folder, header, results)

    def _frames(self) -> list[tuple[int, MapFrame]]:
        frames = work.summary(self.maps, MapsDrawn).frames
        return [(i, frame) for i, frame in enumerate(frames) if frame is not None]


def asked(given: Given) -> MapPages | None:
    """The maps of a scan's stations in pages, where the plan has these on and no splat has a photograph."""
    if "pages" not in given.effects.enabled or given.photos is not None or given.maps is None:
        return None
    return MapPages(given.maps, given.log_gain, form_of(given.settings))
