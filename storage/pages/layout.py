"""Which page is where: photographs, their mip levels, and the grid of pages of each.

Pages are numbered photograph by photograph, level by level from the finest, row by row. Level l of a photograph is
floor(size / 2^l), as OpenGL has it; the last level is the first that one page holds: it and no other is that
photograph's mip tail, which is always resident (2020, section 4.1).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np


def level_size(width_px: int, height_px: int, level: int) -> tuple[int, int]:
    """Width and height of a mip level.

    >>> level_size(1536, 1024, 2), level_size(5, 3, 1)
    ((384, 256), (2, 1))
    """
    return max(1, width_px >> level), max(1, height_px >> level)


@dataclass(frozen=True)
class PageLayout:
    """Of all photographs of a page file. Arrays of pages are int64."""

    sizes_px: tuple[tuple[int, int], ...]  # width, height of each photograph
    page_px: int = 128

    @cached_property
    def grids(self) -> np.ndarray:
        """(n_grids, 5): photograph, level, first page, columns, rows; in the order of the pages."""
        rows, first = [], 0
        for photo, (width, height) in enumerate(self.sizes_px):
            for level in range(self.n_levels(photo)):
                columns, lines = (-(-side // self.page_px) for side in level_size(width, height, level))
                rows.append((photo, level, first, columns, lines))
                first += columns * lines
        return np.array(rows, np.int64).reshape(-1, 5)

    def n_levels(self, photo: int) -> int:
        width, height = self.sizes_px[photo]
        level = 0
        while max(level_size(width, height, level)) > self.page_px:
            level += 1
        return level + 1

    @cached_property
    def texels_a_page(self) -> np.ndarray:
        """(n_grids, 2) float64: how many pixels of the finest level a page of each grid is wide and high."""
        sizes = np.array(self.sizes_px, np.float64).reshape(-1, 2)[self.grids[:, 0]]
        own = np.maximum(1, np.floor(sizes / np.exp2(self.grids[:, 1:2])))
        return self.page_px * sizes / own

    @property
    def n_pages(self) -> int:
        if not len(self.grids):
            return 0
        *_, first, columns, rows = self.grids[-1]
        return int(first + columns * rows)

    @cached_property
    def first_grid(self) -> np.ndarray:
        """(n_photos,) row of `grids` of each photograph's finest level."""
        return np.flatnonzero(self.grids[:, 1] == 0)

    @cached_property
    def levels(self) -> np.ndarray:
        """(n_photos,) how many levels each photograph has."""
        return np.array([self.n_levels(photo) for photo in range(len(self.sizes_px))], np.int64)

    def pages_at(self, photo: np.ndarray, level: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """The page (n,) that holds the texel at x, y (pixels of the finest level) of `level`, each (n,).

        Guarantees: levels and places outside a photograph are taken to its nearest."""
        level = np.clip(level, 0, self.levels[photo] - 1)
        at = self.first_grid[photo] + level
        grid, scale = self.grids[at], self.texels_a_page[at]
        column = np.clip(np.floor(x / scale[:, 0]), 0, grid[:, 3] - 1).astype(np.int64)
        row = np.clip(np.floor(y / scale[:, 1]), 0, grid[:, 4] - 1).astype(np.int64)
        return grid[:, 2] + row * grid[:, 3] + column

    def places_of(self, pages: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Photograph, level, column and row of pages, each (n,)."""
        grid = self.grids[np.searchsorted(self.grids[:, 2], pages, side="right") - 1]
        inside = pages - grid[:, 2]
        return grid[:, 0], grid[:, 1], inside % grid[:, 3], inside // grid[:, 3]

    @cached_property
    def parents(self) -> np.ndarray:
        """(n_pages,) the page of the next coarser level that shows the same; -1 of tails."""
        pages = np.arange(self.n_pages)
        photo, level, column, row = self.places_of(pages)
        width, height = self.texels_a_page[self.first_grid[photo] + level].T
        parent = self.pages_at(photo, level + 1, (column + 0.5) * width, (row + 0.5) * height)
        return np.where(level + 1 < self.levels[photo], parent, -1)

    @cached_property
    def level_of(self) -> np.ndarray:
        """(n_pages,) mip level of each page."""
        return self.places_of(np.arange(self.n_pages))[1]

    @cached_property
    def is_tail(self) -> np.ndarray:
        """(n_pages,) bool: always resident."""
        return self.parents < 0
