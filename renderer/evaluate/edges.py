"""Close-ups of edges with cliplines and without, beside the photograph: where the lines gain most, and where they lose
most.

Without them is the same file with its lines left out: textures do not depend on lines, so what differs is the clip
alone.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.effects.exposure.photographs import read_photo, read_photo_window
from renderer.evaluate.close_ups import window_view
from renderer.evaluate.compare import difference, fullest_square, psnr_db
from renderer.evaluate.previews import even_choice, limited_view
from renderer.pictures import resized, save_picture
from renderer.report.document import EdgeShown
from renderer.splats.renderer import Renderer
from renderer.splats.scene import GpuScene
from storage.packed.packed import PackedFile, PackedScene
from storage.packed.schema import EXTRAS, Camera

FOLDER = "edges"
N_CAMERAS = 4  # that are looked through for edges
N_GAINED = 3  # of their squares are shown, and the one that loses most
LOOKED_AT_PX = 1024  # the longer side of the pictures that are searched
SIDE_PX = 72  # of the photograph
ZOOM = 6


def without_cliplines(scene: PackedScene) -> PackedScene:
    """The same scene with whole discs."""
    names = next({extra.stream, extra.table} for extra in EXTRAS if extra.flag == "clipline")
    batches = tuple(replace(batch, clipline=False) for batch in scene.header.batches)
    return PackedScene(
        replace(scene.header, batches=batches), {k: v for k, v in scene.arrays.items() if k not in names}
    )


def draw_edges(packed: Path, photos: Path, folder: Path) -> list[EdgeShown]:
    """Squares of photographs in which cliplines bring the picture nearest to the photograph, one a camera, and the one
    in which they take it farthest away, magnified: `pictures` by `with`, `without` and `photo`, as paths relative to
    `folder`; PSNR is against the photograph over the pixels that both cover. Nothing of a file without cliplines or
    without cameras.
    """
    with PackedFile(packed) as opened:
        scene = opened.load()
    if not (scene.header.cameras and "cliplines" in scene.arrays):
        return []
    renderer = Renderer()
    scenes = {
        "with": GpuScene(scene, renderer.context),
        "without": GpuScene(without_cliplines(scene), renderer.context),
    }

    def draw(view: Camera) -> dict:
        return {name: renderer.render(gpu_scene, view) for name, gpu_scene in scenes.items()}

    rows: list[EdgeShown] = []
    for i, left, top, side in _chosen(draw, scene.header.cameras, photos):
        photo = read_photo_window(photos, i, left, top, left + side, top + side)
        rows.append(_row(draw, scene.header.cameras[i], photo, (left, top, side), Path(folder), len(rows)))
    for gpu_scene in scenes.values():
        gpu_scene.release()
    return rows


def _chosen(draw, cameras: tuple[Camera, ...], photos: Path) -> list[tuple[int, int, int, int]]:
    """Camera, left, top and side of the squares that are shown."""
    gained: list[tuple[float, int, int, int, int]] = []
    lost: list[tuple[float, int, int, int, int]] = []
    for i in even_choice(len(cameras), N_CAMERAS):
        nearer = _nearer(draw, cameras[i], read_photo(photos, i))
        shrink = nearer.shape[1] / cameras[i].width_px
        for found, values in ((gained, nearer), (lost, -nearer)):
            amount, row, column = fullest_square(values, max(1, round(SIDE_PX * shrink)))
            if amount > 0:
                found.append((-amount, i, *_in_photo(cameras[i], row / shrink, column / shrink)))
    return [found[1:] for found in sorted(gained)[:N_GAINED] + sorted(lost)[:1]]


def _nearer(draw, camera: Camera, photo: np.ndarray) -> np.ndarray:
    """By how much each pixel of a camera's view is nearer to the photograph with lines than without, (height,
    width)."""
    view = limited_view(camera, LOOKED_AT_PX)
    drawn, photo = draw(view), resized(photo, view.width_px, view.height_px)
    covered = drawn["with"].coverage & drawn["without"].coverage
    return difference(drawn["without"].rgb, photo, covered) - difference(drawn["with"].rgb, photo, covered)


def _in_photo(camera: Camera, top: float, left: float) -> tuple[int, int, int]:
    """Left, top and side of a square in pixels of the photograph, within it."""
    side = min(SIDE_PX, camera.width_px, camera.height_px)
    x, y = (int(np.clip(round(at), 0, size - side)) for at, size in ((left, camera.width_px), (top, camera.height_px)))
    return x, y, side


def _row(draw, camera: Camera, photo: np.ndarray, square: tuple[int, int, int], folder: Path, number: int) -> EdgeShown:
    left, top, side = square
    drawn = draw(window_view(camera, *square, ZOOM))
    shown = {name: picture.rgb for name, picture in drawn.items()} | {"photo": resized(photo, side * ZOOM, side * ZOOM)}
    covered = drawn["with"].coverage & drawn["without"].coverage
    pictures = {name: f"{FOLDER}/{number + 1}.{name}.png" for name in shown}
    for name, rgb in shown.items():
        save_picture(folder / pictures[name], rgb)
    with_db, without_db = (psnr_db(shown[name], shown["photo"], covered) for name in ("with", "without"))
    return EdgeShown(camera.name, left, top, side, with_db, without_db, pictures)
