"""Pictures of a packed scene, beside the baseline and the photographs, and how alike they are.

Every figure of a view is taken over the pixels that splats cover in the packed picture and in the baseline: what the
scan never saw says nothing of the compression. `coverage` is their share of the picture.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from renderer.evaluate.compare import psnr_db, ssim
from renderer.evaluate.holes import outline_holes
from renderer.pictures import on_background, resized, save_picture
from renderer.report.document import ViewMeasured
from renderer.splats.baseline import PhotoSplats
from renderer.splats.renderer import Picture, Renderer
from renderer.splats.scene import GpuScene
from renderer.splats.targets import USUAL
from renderer.splats.views import framed_views, hides_backs, station_views, view_of
from storage.packed.packed import PackedScene
from storage.packed.schema import Camera

FOLDER = "previews"
MAX_NAME = 80
WARM_UP_PX = (64, 48)
FIGURES = (
    "psnr_vs_baseline_db",
    "ssim_vs_baseline",
    "psnr_vs_photo_db",
    "ssim_vs_photo",
    "baseline_psnr_vs_photo_db",
)

ReadPhoto = Callable[[int], np.ndarray]  # position in header.cameras -> (height, width, 3) uint8 sRGB


@dataclass(frozen=True)
class PreviewOptions:
    """How many pictures, and how large."""

    n_cameras: int = 12
    n_orbits: int = 4  # where a scan has no cameras
    max_side_px: int = 1600  # larger photographs are compared at this size
    orbit_size_px: tuple[int, int] = (960, 720)


def make_previews(
    scene: PackedScene,
    folder: Path,
    read_photo: ReadPhoto | None = None,
    renderer: Renderer | None = None,
    options: PreviewOptions = PreviewOptions(),
    progress: Callable[[int, int], None] = lambda done, total: None,
    stations: Sequence[tuple[float, float, float]] = (),
) -> list[ViewMeasured]:
    """Write pictures into `folder`/previews and return `quality.views` of the report.

    Renderings are PNGs whose alpha is their coverage. From up to `n_cameras` of the scene's cameras, evenly among them:
    `NAME.packed.png` and, with `read_photo`, `NAME.baseline.png` and `NAME.photo.jpg`. Without cameras: from up to
    `n_cameras` of the `stations` of a laser scan, and `n_orbits` views around the scene, packed alone. `progress` is
    told after every view how many of them are done.

    Figures are None where there is nothing to compare with; `holes` are of the outline (`holes.py`), `accumulation` is
    what colours were added up in (`renderer/splats/targets.py`), `seconds` are by render pass, `pictures` by kind, as
    paths relative to `folder`.

    Guarantees: names of pictures are plain and differ from each other, whatever the cameras are called; a picture
    appears under its name only when it is whole.
    """
    cameras = scene.header.cameras
    chosen = even_choice(len(cameras), options.n_cameras)
    views = [limited_view(cameras[i], options.max_side_px) for i in chosen]
    if not cameras:
        inside = [stations[i] for i in even_choice(len(stations), options.n_cameras)]
        views = station_views(scene, inside, options.orbit_size_px)
        views, read_photo = views + framed_views(scene, options.n_orbits, options.orbit_size_px), None
    names = safe_names([view.name for view in views])
    renderer = renderer or Renderer(antialias=USUAL)
    device = renderer.context.info["GL_RENDERER"]
    gpu_scene = GpuScene(scene, renderer.context, front_only=hides_backs(scene, views))
    photos = PhotoSplats(gpu_scene, read_photo) if read_photo else None
    waiting: list[Future] = []

    def finish(i: int, view: Camera, packed: Picture, baseline: Picture | None) -> ViewMeasured:
        photo = resized(read_photo(chosen[i]), view.width_px, view.height_px) if read_photo else None
        pictures = _save(Path(folder), names[i], packed, baseline, photo)
        return _measured(view, packed, baseline, photo, device, pictures)

    try:
        with ThreadPoolExecutor(1) as pool:  # compares and writes a view while the next one is drawn
            for i, view in enumerate(views):
                if i == 0:
                    _compile(renderer, gpu_scene, photos, view)
                waiting.append(pool.submit(finish, i, view, *_draw(renderer, gpu_scene, photos, view)))
                if i:  # no more than two views' pictures at a time
                    waiting[i - 1].result()
                    progress(i, len(views))
            rows = [done.result() for done in waiting]
            progress(len(views), len(views))
    finally:
        if photos:
            photos.release()
        gpu_scene.release()
    return rows


def even_choice(n: int, n_chosen: int) -> list[int]:
    """At most `n_chosen` of the numbers 0..n-1, evenly, the first and the last among them.

    >>> even_choice(11, 3), even_choice(2, 12), even_choice(0, 12)
    ([0, 5, 10], [0, 1], [])
    """
    return [int(i) for i in np.linspace(0, n - 1, min(n, n_chosen)).round()]


def limited_view(camera: Camera, max_side_px: int) -> Camera:
    """The view of a camera, made smaller where its longer side exceeds `max_side_px`."""
    shrink = min(1.0, max_side_px / max(camera.width_px, camera.height_px))
    return view_of(camera, (max(1, round(camera.width_px * shrink)), max(1, round(camera.height_px * shrink))))


def safe_names(names: Sequence[str]) -> list[str]:
    """File names without ending for cameras: ASCII letters, digits, dot, dash and underscore, all different.

    They differ without regard to case too, for file systems that have none.

    >>> safe_names(["left/0001.jpg", "right/0001.jpg", "right_0001.png", "../../x", "häuser 2"])
    ['left_0001', 'right_0001', 'right_0001-2', 'x', 'h_user_2']
    """
    taken, result = set(), []
    for name in names:
        stem = re.sub(r"[^A-Za-z0-9._-]", "_", re.sub(r"\.\w{1,5}$", "", name))
        stem = stem.lstrip("._-")[:MAX_NAME] or "view"
        unique, repeat = stem, 1
        while unique.lower() in taken:
            repeat += 1
            unique = f"{stem}-{repeat}"
        taken.add(unique.lower())
        result.append(unique)
    return result


def _compile(renderer: Renderer, gpu_scene: GpuScene, photos: PhotoSplats | None, view: Camera) -> None:
    """Draw a small picture, so that the passes of the first view are timed as the others are. Splats so small may
    overdraw a pixel, which says nothing of the views."""
    accumulation = gpu_scene.accumulation
    _draw(renderer, gpu_scene, photos, view_of(view, WARM_UP_PX))
    gpu_scene.accumulation = accumulation


def _draw(
    renderer: Renderer, gpu_scene: GpuScene, photos: PhotoSplats | None, view: Camera
) -> tuple[Picture, Picture | None]:
    packed = renderer.render(gpu_scene, view)
    return packed, renderer.render_baseline(photos, view) if photos else None


def _save(
    folder: Path, name: str, packed: Picture, baseline: Picture | None, photo: np.ndarray | None
) -> dict[str, str]:
    pictures = {"packed": (f"{FOLDER}/{name}.packed.png", on_background(packed.rgb, packed.alpha))}
    if baseline is not None:
        pictures["baseline"] = (f"{FOLDER}/{name}.baseline.png", on_background(baseline.rgb, baseline.alpha))
    if photo is not None:
        pictures["photo"] = (f"{FOLDER}/{name}.photo.jpg", photo)
    for path, rgb in pictures.values():
        save_picture(folder / path, rgb)
    return {kind: path for kind, (path, _) in pictures.items()}


def _measured(
    view: Camera,
    packed: Picture,
    baseline: Picture | None,
    photo: np.ndarray | None,
    device: str,
    pictures: dict[str, str],
) -> ViewMeasured:
    figures: dict[str, float | None] = dict.fromkeys(FIGURES)
    covered = packed.coverage
    if baseline is not None:
        covered = covered & baseline.coverage
        figures["psnr_vs_baseline_db"] = psnr_db(packed.rgb, baseline.rgb, covered)
        figures["ssim_vs_baseline"] = ssim(packed.rgb, baseline.rgb, covered)
    if photo is not None:
        figures["psnr_vs_photo_db"] = psnr_db(packed.rgb, photo, covered)
        figures["ssim_vs_photo"] = ssim(packed.rgb, photo, covered)
        figures["baseline_psnr_vs_photo_db"] = psnr_db(baseline.rgb, photo, covered)
    return ViewMeasured(
        camera=view.name,
        width_px=view.width_px,
        height_px=view.height_px,
        **figures,
        coverage=float(covered.mean()),
        holes=outline_holes(packed.coverage),
        seconds=packed.pass_seconds,
        baseline_seconds=baseline.pass_seconds if baseline is not None else None,
        device=device,
        pictures=pictures,
        accumulation=packed.accumulation,
        programs=tuple(packed.programs),
    )
