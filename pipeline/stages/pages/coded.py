"""The parts of a page file: the pages of one picture, coded into a file of their own, and all of these in one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.numerics.accuracy import psnr_db
from pipeline.planning.settings import Settings
from pipeline.stages.pages.codecs import CODECS, DEFAULT_QUALITY
from pipeline.stages.pages.cut import inner_size, pages_of
from storage import place
from storage.pages.file import PageHeader, write_pages
from storage.pages.layout import PageLayout
from storage.whole import whole
from storage.work import work

FILE = "photographs.pages"
DEFAULT_PAGE_PX, DEFAULT_BORDER_PX = 128, 4


@dataclass(frozen=True)
class PageForm:
    """How pages are cut and coded."""

    codec: str = "jpeg"
    page_px: int = DEFAULT_PAGE_PX
    border_px: int = DEFAULT_BORDER_PX
    quality: int = DEFAULT_QUALITY


def form_of(settings: Settings) -> PageForm:
    """What the settings ask of pages."""
    return PageForm(settings.page_codec, quality=settings.page_quality)


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
class PictureCoded:
    """What a task tells of its picture; the error is of `n` values."""

    n_pages: int
    bytes: int
    squared_error: float
    n: int


def code_picture(folder: Path, index: int, rgb: np.ndarray, form: PageForm) -> PictureCoded:
    """Code the pages of picture `index` (h, w, 3) uint8, one after the other."""
    codec, side = CODECS[form.codec], form.page_px + 2 * form.border_px
    size = rgb.shape[1], rgb.shape[0]
    layout = PageLayout((size,), form.page_px)
    places = zip(*(v.tolist() for v in layout.places_of(np.arange(layout.n_pages))), strict=True)
    lengths, squared, n_texels = [], 0.0, 0
    with whole(_pages(folder, index)) as partial, open(partial, "wb") as stream:
        pages = pages_of(rgb, int(layout.levels[0]), form.page_px, form.border_px)
        for page, (_, level, column, row) in zip(pages, places, strict=True):
            data = codec.encode(np.ascontiguousarray(page), form.quality)
            lengths.append(len(data))
            stream.write(data)
            width, height = inner_size(*size, level, column, row, form.page_px)
            inner = np.s_[form.border_px : form.border_px + height, form.border_px : form.border_px + width]
            lost = page[inner].astype(np.float64) - codec.decode(data, side)[inner]
            squared, n_texels = squared + float(np.sum(lost * lost)), n_texels + lost.size
    work.write_part(_lengths(folder, index), np.array(lengths, np.uint32))
    return PictureCoded(layout.n_pages, sum(lengths), squared / 255**2, n_texels)


def join_pages(folder: Path, header: PageHeader, results: list[PictureCoded]) -> PagesMade:
    """All pictures' pages in one file, FILE; one page at a time is held. `results` are those of `code_picture`."""
    layout = header.layout
    n_bytes = write_pages(folder / FILE, header, _joined(folder, len(header.names)))
    return PagesMade(
        n_photographs=len(header.names),
        n_pages=layout.n_pages,
        bytes=n_bytes,
        raw_bytes=3 * sum(w * h for w, h in layout.sizes_px),
        psnr_db=psnr_db(sum(r.squared_error for r in results), sum(r.n for r in results)),
        codec=header.codec,
        page_px=layout.page_px,
        border_px=header.border_px,
    )


def _joined(folder: Path, n_pictures: int) -> Iterator[bytes]:
    for index in range(n_pictures):
        with open(place.here(_pages(folder, index)), "rb") as stream:
            for length in work.map_part(_lengths(folder, index)).tolist():
                yield stream.read(length)


def _pages(folder: Path, index: int) -> Path:
    return work.parts(folder) / f"{index}.pages"


def _lengths(folder: Path, index: int) -> Path:
    return work.parts(folder) / f"{index}.npy"
