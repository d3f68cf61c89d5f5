"""The page file: what is written is read, and nothing else is believed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from storage.errors import InvalidPackedFile
from storage.pages.file import PageFile, PageHeader, write_pages
from storage.pages.layout import PageLayout, level_size

SIZES = st.lists(st.tuples(st.integers(1, 900), st.integers(1, 900)), min_size=1, max_size=4)


def header_of(sizes=((300, 200), (90, 40)), page_px=64) -> PageHeader:
    layout = PageLayout(tuple(sizes), page_px)
    return PageHeader(tuple(f"ü {i}.jpg" for i in range(len(sizes))), layout, 4, "jpeg", "0123456789abcdef")


def contents(header: PageHeader) -> list[bytes]:
    return [bytes([i % 251]) * (1 + i % 7) for i in range(header.layout.n_pages)]


@given(SIZES)
def test_layout__numbers_every_page_of_every_level_once(sizes):
    layout = PageLayout(tuple(sizes), 64)
    counted = 0
    for photo, (width, height) in enumerate(sizes):
        for level in range(layout.n_levels(photo)):
            w, h = level_size(width, height, level)
            for y in range(0, h, 64):
                for x in range(0, w, 64):
                    middle = ((x + 0.5) * width / w, (y + 0.5) * height / h)  # of a texel, in px of the finest level
                    place = [np.array([v]) for v in (photo, level, *middle)]
                    assert layout.pages_at(*place)[0] == counted
                    assert [int(v[0]) for v in layout.places_of(np.array([counted]))] == [
                        photo,
                        level,
                        x // 64,
                        y // 64,
                    ]
                    counted += 1
    assert counted == layout.n_pages and layout.is_tail.sum() == len(sizes)


@given(SIZES)
def test_layout__a_parent_shows_what_its_children_do_and_tails_have_none(sizes):
    layout = PageLayout(tuple(sizes), 64)
    pages = np.flatnonzero(~layout.is_tail)
    photo, level, column, row = layout.places_of(pages)
    up = layout.places_of(layout.parents[pages])
    assert np.array_equal(up[0], photo) and np.array_equal(up[1], level + 1)
    grids = layout.grids[np.searchsorted(layout.grids[:, 2], layout.parents[pages], side="right") - 1]
    assert np.array_equal(up[2], np.minimum(column // 2, grids[:, 3] - 1))
    assert np.array_equal(up[3], np.minimum(row // 2, grids[:, 4] - 1))


@settings(max_examples=20)
@given(SIZES)
def test_pages__what_is_written_is_read(tmp_path_factory, sizes):
    header, path = header_of(sizes), tmp_path_factory.mktemp("pages") / "a.pages"
    pages = contents(header)
    assert write_pages(path, header, iter(pages)) == path.stat().st_size
    with PageFile(path) as opened:
        assert opened.header == header
        assert [opened.read(i) for i in range(header.layout.n_pages)] == pages
        assert opened.lengths().tolist() == [len(page) for page in pages]


def test_pages__refuses_every_truncation_and_an_extra_byte(tmp_path):
    header, path = header_of(), tmp_path / "a.pages"
    write_pages(path, header, contents(header))
    data = path.read_bytes()
    for n in [*range(0, len(data), 7), len(data) - 1]:
        path.write_bytes(data[:n])
        with pytest.raises(InvalidPackedFile):
            PageFile(path)
    path.write_bytes(data + b"x")
    with pytest.raises(InvalidPackedFile, match="bytes where its header says"):
        PageFile(path)


def test_pages__refuses_every_altered_byte_at_the_head_or_when_its_page_is_read(tmp_path):
    header, path = header_of(), tmp_path / "a.pages"
    write_pages(path, header, contents(header))
    data = path.read_bytes()
    for at in range(0, len(data), 3):
        path.write_bytes(data[:at] + bytes([data[at] ^ 0x40]) + data[at + 1 :])
        with pytest.raises(InvalidPackedFile), PageFile(path) as opened:
            for page in range(opened.layout.n_pages):
                opened.read(page)


def test_pages__too_few_pages_leave_no_file(tmp_path):
    header = header_of()
    with pytest.raises(ValueError, match="pages for a layout"):
        write_pages(tmp_path / "a.pages", header, contents(header)[:-1])
    assert not list(tmp_path.iterdir())
