"""Close-ups of a scan in each of several ways to keep its textures, and what each costs to draw (HPG 2021, Tables 2,
3)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.effects.exposure.photographs import read_photo
from pipeline.numerics.accuracy import psnr_db as psnr_db_of_error
from pipeline.stages.packed.measure import SplatErrors, splat_errors
from pipeline.summaries import Photographs
from renderer.evaluate.compare import flip, psnr_db, ssim
from renderer.evaluate.paged_photos import PagedPhotos
from renderer.evaluate.previews import WARM_UP_PX, even_choice, limited_view
from renderer.pictures import save_picture
from renderer.report.evaluation_document import CloseUp, PassTimes, PictureFigures
from renderer.splats.baseline import PHOTO_BUDGET_BYTES, PhotoSplats
from renderer.splats.renderer import Picture, Renderer
from renderer.splats.scene import GpuScene
from renderer.splats.targets import USUAL
from renderer.splats.views import framed_views, view_of
from storage.packed.packed import PackedFile
from storage.packed.schema import NO_CAMERA, Camera
from storage.pages.file import PageFile
from storage.work import work

FOLDER = "close-ups"
SIDE_PX = 96  # of the photograph
ZOOM = 2
GROUPS_LOOKED_AT = 4  # 32,768 splats at most
TIMED_SIDE_PX = 1024
ROUNDS = 3


@dataclass(frozen=True)
class Variant:
    """A packed file, or its splats textured from photographs: a folder with photo_<i> and cameras in its summary; by
    way of `pages`, a page file of them, in a pool of so many bytes where they do not fit it."""

    name: str
    packed: Path
    photos: Path | None = None
    pages: Path | None = None
    pool_bytes: int = PHOTO_BUDGET_BYTES


@dataclass(frozen=True)
class _Spot:
    """A splat worth a look."""

    why: str
    camera: int
    centre: np.ndarray  # (3,) absolute
    error: float


def draw_close_ups(
    variants: Sequence[Variant], packed: Path, ingest: Path, folder: Path, keep: slice = slice(None)
) -> list[CloseUp]:
    """Around chosen splats of `packed`, or those of them that `keep` names, a picture for each variant, in `folder`.

    One a splat; figures are against the first variant, which has none itself.
    """
    spots = choose_spots(packed, ingest)[keep]
    cameras = list(work.summary(ingest, Photographs).cameras)
    views = [close_up(cameras[spot.camera], spot.centre) for spot in spots]
    pictures: list[dict[str, str]] = [{} for _ in spots]
    figures: list[dict[str, PictureFigures | None]] = [{} for _ in spots]
    renderer = Renderer(antialias=USUAL)
    first: list[Picture] = []
    for number, variant in enumerate(variants):
        with drawn(renderer, variant) as draw:
            for i, view in enumerate(views):
                picture = draw(view)
                if number == 0:
                    first.append(picture)
                path = f"{FOLDER}/{i + 1}-{number:02d}.png"
                save_picture(Path(folder) / path, picture.rgb)
                pictures[i][variant.name] = path
                figures[i][variant.name] = figures_of(picture, first[i]) if number else None
    return [
        CloseUp(spot.why, cameras[spot.camera].name, psnr_db_of_error(spot.error, 1), pictures[i], figures[i])
        for i, spot in enumerate(spots)
    ]


def figures_of(picture: Picture, first: Picture) -> PictureFigures:
    """Over the pixels that both cover."""
    covered = picture.coverage & first.coverage
    return PictureFigures(*(measure(picture.rgb, first.rgb, covered) for measure in (psnr_db, ssim, flip)))


def time_passes(variants: Sequence[Variant]) -> list[PassTimes]:
    """Median seconds of each pass, by variant, for one view of the whole scan; in turns, so that a load on the machine
    falls on all of them alike."""
    renderer = Renderer()
    with PackedFile(variants[0].packed) as packed:
        cameras = packed.header.cameras
        if cameras:
            view = limited_view(cameras[len(cameras) // 2], TIMED_SIDE_PX)
        else:
            view = framed_views(packed.load(), 1, (TIMED_SIDE_PX, TIMED_SIDE_PX * 3 // 4))[0]
    seconds: dict[str, list[dict[str, float]]] = {variant.name: [] for variant in variants}
    with ExitStack() as opened:
        draws = {variant.name: opened.enter_context(drawn(renderer, variant)) for variant in variants}
        for draw in draws.values():
            draw(view_of(view, WARM_UP_PX))  # uploads photographs, and compiles the shaders
        for _ in range(ROUNDS):
            for name, draw in draws.items():
                seconds[name].append(draw(view).pass_seconds)
    return [
        PassTimes(
            name,
            {p: float(np.median([turn[p] for turn in turns])) for p in turns[0]},
            renderer.context.info["GL_RENDERER"],
            view.width_px,
            view.height_px,
        )
        for name, turns in seconds.items()
    ]


def choose_spots(packed: Path, ingest: Path) -> list[_Spot]:
    """The best and the worst splat by the error of their textures, and four between them, among those whose average
    colour loses more than the median does: where there is nothing to keep, anything keeps it."""
    with PackedFile(packed) as opened:
        groups = even_choice(opened.header.n_groups, GROUPS_LOOKED_AT)
    parts = [splat_errors(ingest, packed, g) for g in groups]
    all_ = SplatErrors(
        *(np.concatenate([getattr(p, name) for p in parts]) for name in ("centre", "camera", "error", "plain"))
    )
    seen = np.flatnonzero(all_.camera != NO_CAMERA)
    seen = seen[all_.plain[seen] >= np.median(all_.plain[seen])]
    by_error = seen[np.argsort(all_.error[seen], kind="stable")]
    chosen = [("around the best splat", by_error[0])]
    chosen += [
        (f"around a splat that {100 * share:.0f} % are better than", by_error[int(share * len(by_error))])
        for share in (0.2, 0.4, 0.6, 0.8)
    ]
    chosen.append(("around the worst splat", by_error[-1]))
    return [_Spot(why, int(all_.camera[i]), all_.centre[i], float(all_.error[i])) for why, i in chosen]


def close_up(camera: Camera, centre: np.ndarray, side_px: int = SIDE_PX, zoom: int = ZOOM) -> Camera:
    """The part of a photograph's view around a point, magnified; it stays within the photograph."""
    side = min(side_px, camera.width_px, camera.height_px)
    x, y, z = np.array(camera.rotation) @ np.subtract(centre, camera.centre)
    left = int(np.clip(round(camera.fx_px * x / z + camera.cx_px - side / 2), 0, camera.width_px - side))
    top = int(np.clip(round(camera.fy_px * y / z + camera.cy_px - side / 2), 0, camera.height_px - side))
    return window_view(camera, left, top, side, zoom)


def window_view(camera: Camera, left: int, top: int, side: int, zoom: int = ZOOM) -> Camera:
    """A square of a photograph's view, its first pixel (left, top), magnified."""
    return replace(
        camera,
        width_px=side * zoom,
        height_px=side * zoom,
        fx_px=camera.fx_px * zoom,
        fy_px=camera.fy_px * zoom,
        cx_px=(camera.cx_px - left) * zoom,
        cy_px=(camera.cy_px - top) * zoom,
    )


@contextmanager
def drawn(renderer: Renderer, variant: Variant) -> Iterator:
    """A function from view to picture."""
    with PackedFile(variant.packed, verify=False) as packed:
        gpu_scene = GpuScene(packed.load(), renderer.context)
    with ExitStack() as opened:
        opened.callback(gpu_scene.release)
        if variant.photos is None:
            yield lambda view: renderer.render(gpu_scene, view)
            return
        cameras = list(work.summary(variant.photos, Photographs).cameras)
        if variant.pages is not None:
            file = opened.enter_context(PageFile(variant.pages))
            paged = PagedPhotos(gpu_scene, file, variant.pool_bytes, cameras)
            opened.callback(paged.release)
            yield lambda view: paged.draw(renderer, view)
            return
        whole = PhotoSplats(gpu_scene, lambda i: read_photo(variant.photos, i), variant.pool_bytes, cameras)
        opened.callback(whole.release)
        yield lambda view: renderer.render_baseline(whole, view)
