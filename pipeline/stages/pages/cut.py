"""A photograph cut into pages: all mip levels, each page with a border of its neighbours' texels (2020, section 4.1).

The border is what filtering across the edge of a page needs; where a photograph ends its last texels are repeated. So
all pages have the same size, and one texture holds any of them.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pipeline.stages.texture.photo_codecs import halved
from storage.pages.layout import level_size


def pages_of(rgb: np.ndarray, n_levels: int, page_px: int, border_px: int) -> Iterator[np.ndarray]:
    """The pages of a photograph (h, w, 3) uint8 in the order of their numbers, each (side, side, 3) uint8, side =
    page_px + 2 border_px.

    Guarantees: level l is the mean of what its texels cover of level l - 1, as `halved`; inside its border a page is
    its level's own texels.
    """
    for level in range(n_levels):
        if level:
            rgb = halved(rgb, 1)
        height, width = rgb.shape[:2]
        below, right = -height % page_px + border_px, -width % page_px + border_px
        padded = np.pad(rgb, ((border_px, below), (border_px, right), (0, 0)), mode="edge")
        for top in range(0, height, page_px):
            for left in range(0, width, page_px):
                yield padded[top : top + page_px + 2 * border_px, left : left + page_px + 2 * border_px]


def inner_size(width_px: int, height_px: int, level: int, column: int, row: int, page_px: int) -> tuple[int, int]:
    """Width and height of what a page shows of its photograph; the rest of it repeats the edge."""
    width, height = level_size(width_px, height_px, level)
    return min(page_px, width - column * page_px), min(page_px, height - row * page_px)
