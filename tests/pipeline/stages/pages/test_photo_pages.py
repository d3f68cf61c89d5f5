"""Photographs cut into pages and coded: each texel once, borders of neighbours, bytes that are no page refused."""

import numpy as np
import pytest

from pipeline.execution.executors import SerialExecutor
from pipeline.execution.stage import run_stage
from pipeline.stages.pages.codecs import CODECS, decoded
from pipeline.stages.pages.coded import FILE, PageForm
from pipeline.stages.pages.cut import inner_size, pages_of
from pipeline.stages.pages.photo_pages import PhotoPages
from pipeline.stages.texture.photo_codecs import halved
from pipeline.summaries import Photographs
from storage.errors import InvalidPackedFile
from storage.pages.file import PageFile, scan_digest
from storage.pages.layout import PageLayout
from storage.work import arrays, work
from tests.pipeline.execution.test_stage import Heard

EYE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def picture(height: int, width: int, seed: int = 3) -> np.ndarray:
    """Smooth, with an edge: what codecs are made for."""
    y, x = np.mgrid[:height, :width]
    rgb = np.stack([x % 251, y % 241, 60 * (x + y > seed * 40)], axis=-1)
    return np.clip(rgb, 0, 255).astype(np.uint8)


def test_cut__every_level_can_be_put_together_again():
    rgb, page_px, border = picture(201, 317), 64, 4
    layout = PageLayout(((317, 201),), page_px)
    pages = list(pages_of(rgb, layout.n_levels(0), page_px, border))
    assert len(pages) == layout.n_pages
    joined = [np.zeros_like(halved(rgb, level)) for level in range(layout.n_levels(0))]
    for number, page in enumerate(pages):
        _, level, column, row = (int(v[0]) for v in layout.places_of(np.array([number])))
        width, height = inner_size(317, 201, level, column, row, page_px)
        part = page[border : border + height, border : border + width]
        joined[level][row * page_px : row * page_px + height, column * page_px : column * page_px + width] = part
    for level, found in enumerate(joined):
        assert np.array_equal(found, halved(rgb, level))


def test_cut__a_border_has_the_texels_of_its_neighbours_and_repeats_the_edge():
    rgb = picture(128, 200)
    first, second, *_ = pages_of(rgb, 1, 64, 4)
    assert np.array_equal(first[4:-4, -4:], rgb[:64, 64:68]) and np.array_equal(second[4:-4, :4], rgb[:64, 60:64])
    assert np.array_equal(first[:4, 4:-4], np.repeat(rgb[:1, :64], 4, axis=0))


@pytest.mark.parametrize(("codec", "least_db"), [("jpeg", 30.0), ("webp", 28.0), ("png", np.inf), ("bc7", 38.0)])
def test_codecs__a_page_comes_back(codec, least_db):
    page = picture(72, 72)
    found = decoded(codec, CODECS[codec].encode(page, 90), 72, "a page")
    squared = float(np.mean((page.astype(float) - found) ** 2))
    assert found.shape == page.shape and (squared == 0 or 10 * np.log10(255**2 / squared) > least_db)


@pytest.mark.parametrize("codec", CODECS)
def test_codecs__what_is_no_page_of_that_size_is_refused(codec):
    data = CODECS[codec].encode(picture(72, 72), 90)
    for harmed in (b"", b"nothing of the sort", data[:20], CODECS[codec].encode(picture(80, 80), 90)):
        with pytest.raises(InvalidPackedFile, match="a page"):
            decoded(codec, harmed, 72, "a page")


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """A folder as the ingest leaves it, of two photographs."""
    folder = tmp_path_factory.mktemp("photos") / "ingest-0123456789abcdef"
    work.begin(folder)
    cameras = []
    for i, (height, width) in enumerate([(150, 301), (90, 60)]):
        arrays.create(folder, f"photo_{i}", (height, width, 3), "uint8", (64, 64, 3))
        arrays.write_picture(folder, f"photo_{i}", picture(height, width, i))
        cameras.append(
            {"name": f"{i}.jpg", "width_px": width, "height_px": height, "fx_px": 200.0, "fy_px": 200.0, "cx_px": width / 2,
             "cy_px": height / 2, "rotation": EYE, "centre": (0.0, 0.0, float(i))}
        )  # fmt: skip
    work.complete(folder, {"cameras": cameras}, 0.0)
    return folder


def test_photo_pages__hold_the_photographs_and_name_their_scan(photos, tmp_path):
    stage = PhotoPages(photos, PageForm("png", 64, 4))
    made = run_stage(stage, tmp_path, SerialExecutor(), Heard())
    assert made.summary.n_photographs == 2 and made.summary.psnr_db == 100.0
    assert not list(made.folder.glob("parts/*"))
    cameras = work.summary(photos, Photographs).cameras
    with PageFile(made.folder / FILE) as file:
        assert file.header.scan == scan_digest(cameras) and file.header.names == ("0.jpg", "1.jpg")
        first = int(file.layout.grids[file.layout.first_grid[1], 2])
        page = decoded("png", file.read(first), 72, "a page")
        assert np.array_equal(page[4:68, 4:64], arrays.read(photos, "photo_1")[:64, :60])


def test_photo_pages__are_the_same_bytes_whatever_the_order_of_tasks(photos, tmp_path):
    stage = PhotoPages(photos, PageForm("jpeg", 64, 4, 80))
    first = run_stage(stage, tmp_path / "a", SerialExecutor(), Heard()).folder / FILE

    class Backwards(SerialExecutor):
        def run(self, stage, folder, indices, on_done):
            super().run(stage, folder, indices[::-1] + indices[:1], on_done)  # one of them twice

    second = run_stage(stage, tmp_path / "b", Backwards(), Heard()).folder / FILE
    assert first.read_bytes() == second.read_bytes()
