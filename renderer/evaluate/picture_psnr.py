"""How near pictures of packed files come to the photographs, where the files differ in how many splats they have.

Texture PSNR is of each file's own splats: of a tenth of them, ten times as large, it is another quantity. Here all
files are drawn from the same cameras, and compared with the photographs over the same pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.effects.exposure.photographs import read_photo
from pipeline.summaries import Photographs
from renderer.evaluate.close_ups import Variant, drawn
from renderer.evaluate.compare import psnr_of_error
from renderer.evaluate.previews import even_choice, limited_view
from renderer.pictures import resized
from renderer.splats.detail import FINEST
from renderer.splats.renderer import Renderer
from renderer.splats.scene import GpuScene
from renderer.splats.targets import USUAL
from renderer.splats.views import framed_views
from storage.packed.packed import PackedFile
from storage.packed.schema import Camera
from storage.work import work

N_VIEWS = 4
MAX_SIDE_PX = 1024
# Of 255 in sRGB: 0.91 of what a pixel shows is of a sample's splats. With 225 estimates are 0.03 dB lower, with 128 0.2.
FILLED = 245


def picture_psnrs(variants: Sequence[Variant], photos: Path | None, fullest: int = 0) -> list[float | None]:
    """PSNR in dB of each variant against the photographs of a folder, the squared error averaged over the pixels of
    N_VIEWS of their cameras that the variant number `fullest`, the one of most splats, covers. A pixel that a variant
    leaves bare counts as black: its holes are errors. Without photographs against the pictures of the fullest, in its
    own colours, from around the scan. None where nothing is covered."""
    renderer = Renderer(antialias=USUAL)
    views, wanted = ([], []) if photos is None else _photographs(photos)
    with drawn(renderer, variants[fullest]) as draw:
        if photos is None:
            with PackedFile(variants[fullest].packed, verify=False) as packed:
                views = framed_views(packed.load(), N_VIEWS, (MAX_SIDE_PX, MAX_SIDE_PX * 3 // 4))
        pictures = [draw(view) for view in views]
    masks = [picture.coverage for picture in pictures]
    wanted = wanted or [picture.rgb for picture in pictures]
    n_values = 3 * sum(int(mask.sum()) for mask in masks)
    if not n_values:
        return [None] * len(variants)
    found: list[float | None] = []
    for variant in variants:
        error = 0
        with drawn(renderer, variant) as draw:
            for view, photo, mask in zip(views, wanted, masks):
                picture = draw(view)
                shown = np.where(picture.coverage[..., None], picture.rgb, np.uint8(0))
                error += _squared(shown, photo, mask)
        found.append(psnr_of_error(error / n_values))
    return found


def sampled_picture_error(of_all: Path, sample: Path, rows: np.ndarray, photos: Path) -> float | None:
    """The squared error to the photographs, a pixel and channel in levels of 255, of the file that `sample` is a sample
    of, its `rows`; `of_all` is a file of all splats without textures. None where no pixel is of the sample's splats.

    It is that of all splats textured from the photographs themselves, over all of the pictures, and what the sample's
    own textures add to it over the pixels that its splats fill: the one says what geometry loses, which differs much
    from place to place, the other what coding loses, which does not."""
    renderer = Renderer(antialias=USUAL)
    views, wanted = _photographs(photos)
    with PackedFile(of_all, verify=False) as packed:
        scene = packed.load()
    mark = np.zeros((scene.header.n_splats, 3), np.uint8)
    mark[rows] = 255
    marked = GpuScene(replace(scene, arrays={**scene.arrays, "color": mark}), renderer.context)
    fills = [renderer.render(marked, view, detail=FINEST).rgb[..., 0] >= FILLED for view in views]
    marked.release()
    with drawn(renderer, Variant("photographs", of_all, photos)) as draw:
        exact = [draw(view) for view in views]
    error, more, n_all, n_filled = 0, 0, 0, 0
    with drawn(renderer, Variant("sample", sample)) as draw:
        for view, photo, filled, best in zip(views, wanted, fills, exact):
            picture = draw(view)
            both = filled & picture.coverage & best.coverage
            error += _squared(best.rgb, photo, best.coverage)
            more += _squared(picture.rgb, photo, both) - _squared(best.rgb, photo, both)
            n_all += 3 * int(best.coverage.sum())
            n_filled += 3 * int(both.sum())
    return max(0.0, error / n_all + more / n_filled) if n_filled else None


def _squared(rgb: np.ndarray, photo: np.ndarray, mask: np.ndarray) -> int:
    return int(((rgb[mask].astype(np.int64) - photo[mask]) ** 2).sum())


def _photographs(photos: Path) -> tuple[list[Camera], list[np.ndarray]]:
    cameras = work.summary(photos, Photographs).cameras
    chosen = even_choice(len(cameras), N_VIEWS)
    views = [limited_view(cameras[i], MAX_SIDE_PX) for i in chosen]
    return views, [resized(read_photo(photos, i), v.width_px, v.height_px) for i, v in zip(chosen, views)]
