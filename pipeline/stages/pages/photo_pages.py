"""Photographs -> one page file: every mip level of each, cut into pages that are coded alone (2020, section 4.4.2)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.numerics.accuracy import psnr_db
from pipeline.stages.pages.codecs import CODECS, DEFAULT_QUALITY
from pipeline.stages.pages.cut import inner_size, pages_of
from pipeline.summaries import Photographs
from storage import place
from storage.packed.schema import Camera
from storage.pages.file import PageHeader, scan_digest, write_pages
from storage.pages.layout import PageLayout
from storage.whole import whole
from storage.work import arrays, work

FILE = "photographs.pages"
DEFAULT_PAGE_PX, DEFAULT_BORDER_PX = 128, 4


@dataclass(frozen=True)
class PagesMade:
    """Of a page file: what it holds, and what its codec lost."""

    n_photographs: int
    n_pages: int
    bytes: int
    raw_bytes: int  # of the photographs, RGB8
    psnr_db: float | None
    codec: str
    page_px: int
    border_px: int


@dataclass(frozen=True)
class PhotoPages:
    """A task a photograph: its pages, one after the other. `photos` has photo_<i> (h, w, 3) uint8 and, in its summary,
    their cameras. Makes FILE."""

    photos: Path
    codec: str = "jpeg"
    page_px: int = DEFAULT_PAGE_PX
    border_px: int = DEFAULT_BORDER_PX
    quality: int = DEFAULT_QUALITY
    one_light: bool = False  # `photos` are those of the stage `exposure`
    name = "photo-pages"

    def init(self, folder: Path) -> int:
        work.parts(folder).mkdir(exist_ok=True)
        return len(self._cameras())

    def run(self, folder: Path, index: int) -> dict:
        camera = self._cameras()[index]
        layout, codec = self._layout([camera]), CODECS[self.codec]
        size, side = layout.sizes_px[0], self.page_px + 2 * self.border_px
        rgb = arrays.read(self.photos, f"photo_{index}")
        places = zip(*(v.tolist() for v in layout.places_of(np.arange(layout.n_pages))), strict=True)
        lengths, squared, n_texels = [], 0.0, 0
        with whole(_pages(folder, index)) as partial, open(partial, "wb") as stream:
            pages = pages_of(rgb, int(layout.levels[0]), self.page_px, self.border_px)
            for page, (_, level, column, row) in zip(pages, places, strict=True):
                data = codec.encode(np.ascontiguousarray(page), self.quality)
                lengths.append(len(data))
                stream.write(data)
                width, height = inner_size(*size, level, column, row, self.page_px)
                inner = np.s_[self.border_px : self.border_px + height, self.border_px : self.border_px + width]
                lost = page[inner].astype(np.float64) - codec.decode(data, side)[inner]
                squared, n_texels = squared + float(np.sum(lost * lost)), n_texels + lost.size
        work.write_part(_lengths(folder, index), np.array(lengths, np.uint32))
        return {"n_pages": layout.n_pages, "bytes": sum(lengths), "squared_error": squared / 255**2, "n": n_texels}

    def finalise(self, folder: Path, results: list[dict]) -> PagesMade:
        cameras = self._cameras()
        layout = self._layout(cameras)
        names = tuple(camera.name for camera in cameras)
        header = PageHeader(names, layout, self.border_px, self.codec, scan_digest(cameras), self.one_light)
        n_bytes = write_pages(folder / FILE, header, self._joined(folder, len(cameras)))
        squared, n = sum(r["squared_error"] for r in results), sum(r["n"] for r in results)
        return PagesMade(
            n_photographs=len(cameras),
            n_pages=layout.n_pages,
            bytes=n_bytes,
            raw_bytes=3 * sum(w * h for w, h in layout.sizes_px),
            psnr_db=psnr_db(squared, n),
            codec=self.codec,
            page_px=self.page_px,
            border_px=self.border_px,
        )

    @staticmethod
    def _joined(folder: Path, n_photos: int) -> Iterator[bytes]:
        """Pages of all photographs; one at a time is held."""
        for index in range(n_photos):
            with open(place.here(_pages(folder, index)), "rb") as stream:
                for length in work.map_part(_lengths(folder, index)).tolist():
                    yield stream.read(length)

    def _cameras(self) -> list[Camera]:
        return list(work.summary(self.photos, Photographs).cameras)

    def _layout(self, cameras: list[Camera]) -> PageLayout:
        return PageLayout(tuple((c.width_px, c.height_px) for c in cameras), self.page_px)


def _pages(folder: Path, index: int) -> Path:
    return work.parts(folder) / f"{index}.pages"


def _lengths(folder: Path, index: int) -> Path:
    return work.parts(folder) / f"{index}.npy"
