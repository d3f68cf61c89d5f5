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
FILLED = 128  # of 255 in sRGB: what of a pixel's colour is of a sample's splats


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
                error += int(((shown[mask].astype(np.int64) - photo[mask]) ** 2).sum())
        found.append(psnr_of_error(error / n_values))
    return found


def sampled_picture_error(of_all: Path, sample: Path, rows: np.ndarray, photos: Path) -> float | None:
    """The squared error to the photographs, a pixel and channel in levels of 255, of the file that `sample` is a sample
    of: over the pixels of the same views that its splats fill. These are told by `of_all`, a file of all splats
    without textures, of which the sample has `rows`: so what hides what is the whole file's. None where it fills no
    pixel."""
    renderer = Renderer(antialias=USUAL)
    views, wanted = _photographs(photos)
    with PackedFile(of_all, verify=False) as packed:
        scene = packed.load()
    mark = np.zeros((scene.header.n_splats, 3), np.uint8)
    mark[rows] = 255
    marked = GpuScene(replace(scene, arrays={**scene.arrays, "color": mark}), renderer.context)
    fills = [renderer.render(marked, view, detail=FINEST).rgb[..., 0] >= FILLED for view in views]
    marked.release()
    error, n_values = 0, 0
    with drawn(renderer, Variant("sample", sample)) as draw:
        for view, photo, filled in zip(views, wanted, fills):
            picture = draw(view)
            both = filled & picture.coverage
            error += int(((picture.rgb[both].astype(np.int64) - photo[both]) ** 2).sum())
            n_values += 3 * int(both.sum())
    return error / n_values if n_values else None


def _photographs(photos: Path) -> tuple[list[Camera], list[np.ndarray]]:
    cameras = work.summary(photos, Photographs).cameras
    chosen = even_choice(len(cameras), N_VIEWS)
    views = [limited_view(cameras[i], MAX_SIDE_PX) for i in chosen]
    return views, [resized(read_photo(photos, i), v.width_px, v.height_px) for i, v in zip(chosen, views)]
