"""Pictures of a packed file, as files; and how well its splats cover its surface in them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from renderer.effects.relighting import Light
from renderer.evaluate.coverage import surface_coverage
from renderer.evaluate.holes import outline_holes, outline_of, painted_holes
from renderer.evaluate.previews import safe_names
from renderer.evaluate.unscanned import scanned_points, surrounded
from renderer.pictures import on_background, save_animation, save_picture
from renderer.residency.pooled import PooledFile
from renderer.splats.detail import Detail
from renderer.splats.renderer import Picture, Renderer
from renderer.splats.scene import GpuScene
from renderer.splats.targets import NARROW, USUAL, WIDE
from renderer.splats.views import framed_views, hides_backs, orbit_views, view_of
from storage.errors import InvalidScan
from storage.packed.packed import PackedFile, PackedScene
from storage.packed.schema import GROUP, MAX_ATOMS, QUADRICS, Camera, Header

DEFAULT_SIZE = (1280, 720)
OUTLINE_VIEWS, SIZE_PX = 4, (960, 720)


def render_views(
    packed: Path,
    out: Path,
    *,
    camera: str | None = None,
    n_orbit: int | None = None,
    size: tuple[int, int] | None = None,
    max_atoms: int = MAX_ATOMS,
    precision: str = "auto",
    antialias: int = USUAL,
    light: Light | None = None,
    background: tuple[int, int, int] | None = None,
    animated: bool = False,
    up: tuple[float, float, float] | None = None,
    detail: Detail = Detail(),
    pool_mib: float | None = None,
    front_only: bool = False,
) -> list[Path]:
    """Render one camera's view or `n_orbit` views around the scan into PNGs in `out`, with their coverage as alpha or
    on a `background`, and where `animated` into turntable.webp beside them; returns their paths. `precision`
    and `antialias` are those of pipeline.planning.knobs.VIEW_KNOBS. With a `light`
    it is lit, whether or not the file asks for it; with smoothed normals, unless it was planned without. `up` is
    what is up around the scan, where the file does not know; `detail` which of its levels are drawn, with `pool_mib`
    from no more than so many MiB of its splats in memory. With `front_only`, or where they are hidden
    anyway, discs that show their backs are left out."""
    renderer = Renderer(antialias=antialias)

    def prepare(gpu_scene: GpuScene) -> None:
        if precision != "auto":
            gpu_scene.accumulation, gpu_scene.watched = {"16": NARROW, "32": WIDE}[precision], False
        if light is not None and "relighting" not in gpu_scene.drawn:
            gpu_scene.drawn |= {"relighting", "normal_smoothing"}

    paths, frames = [], []
    with PackedFile(packed) as opened:
        scene = _viewed(opened, pool_mib)
        if camera is not None:
            views = [view_of(_camera_named(scene.header, camera, packed), size)]
        else:
            views = (orbit_views if animated else framed_views)(scene, n_orbit, size or DEFAULT_SIZE, up)
        draw = _drawing(
            opened, scene, renderer, pool_mib, prepare, front_only or (pool_mib is None and hides_backs(scene, views))
        )
        for view, name in zip(views, safe_names([v.name for v in views])):
            paths.append(out / f"{name}.png")
            paths[-1].parent.mkdir(parents=True, exist_ok=True)
            picture = draw(view, max_atoms, light, detail)
            frames.append(on_background(picture.rgb, picture.alpha, background))
            save_picture(paths[-1], frames[-1])
            frames = frames if animated else []
    if animated:
        paths.append(out / "turntable.webp")
        save_animation(paths[-1], frames)
    return paths


def _viewed(opened: PackedFile, pool_mib: float | None) -> PackedScene:
    """What views are made of; with a pool no more than the boxes of the file, or the coarsest level over quadrics, is
    read for that."""
    if pool_mib is None:
        return opened.load()
    if (
        opened.header.geometry == QUADRICS
    ):  # whose chunks lie where their splats are decoded: those of the coarsest level, which views go by
        coarsest = range(opened.header.levels[0] // GROUP)
        rows = {group: opened.rows_of_group(group) for group in coarsest}
        return opened.joined(rows, opened.of_all())
    return PackedScene(opened.header, {name: opened.read(name) for name in ("box_low", "box_size")})


def _drawing(
    opened: PackedFile,
    scene: PackedScene,
    renderer: Renderer,
    pool_mib: float | None,
    prepare: Callable[[GpuScene], None],
    front_only: bool,
) -> Callable[..., Picture]:
    """A function that draws a view."""
    if pool_mib is not None:
        return partial(PooledFile(opened, renderer.context, int(pool_mib * (1 << 20)), prepare).render, renderer)
    gpu_scene = GpuScene(scene, renderer.context, front_only=front_only)
    prepare(gpu_scene)
    return partial(renderer.render, gpu_scene)


def _camera_named(header: Header, name: str, packed: Path) -> Camera:
    for camera in header.cameras:
        if camera.name == name:
            return camera
    names = ", ".join(c.name for c in header.cameras[:20]) or "none: use --orbit"
    raise InvalidScan(str(packed), f"no camera {name!r}", names)


def coverage_of(packed: Path, up: tuple[float, float, float] | None = None, pictures: Path | None = None) -> dict:
    """`surface`: rows of three views from one distance, ring_000 and on, as `renderer.evaluate.coverage` measures
    discs; `outline`: of four orbit views as they are drawn, `camera`, `coverage` and `holes`, the share of pixels
    without a splat inside the outline closed by 9x9 px: of these `uncovered` have points of the scan on all sides,
    `unscanned` have not (renderer/evaluate/unscanned.py). Into the folder `pictures` goes each view with its holes
    painted."""
    with PackedFile(packed) as opened:
        scene = opened.load()
    renderer = Renderer(antialias=USUAL)
    views = framed_views(scene, OUTLINE_VIEWS, SIZE_PX, up)
    outline, points = [], scanned_points(scene)
    for view, drawn in zip(views, _pictures(renderer, scene, views)):
        uncovered = surrounded(view, outline_of(drawn.coverage) & ~drawn.coverage, *points)
        filled = drawn.coverage | uncovered
        outline.append(
            {
                "camera": view.name,
                "coverage": float(drawn.coverage.mean()),
                "holes": outline_holes(drawn.coverage),
                "uncovered": outline_holes(drawn.coverage, ~uncovered),
                "unscanned": outline_holes(drawn.coverage, filled),
            }
        )
        if pictures is not None:
            pictures.mkdir(parents=True, exist_ok=True)
            save_picture(pictures / f"{view.name}.png", painted_holes(drawn.rgb, drawn.coverage, filled))
    ring = (replace(row, camera=row.camera.replace("orbit", "ring")) for row in surface_coverage(scene, up=up))
    return {"surface": [asdict(row) for row in ring], "outline": outline}


def _pictures(renderer: Renderer, scene: PackedScene, views: list[Camera]) -> list[Picture]:
    gpu_scene = GpuScene(scene, renderer.context)
    found = [renderer.render(gpu_scene, view) for view in views]
    gpu_scene.release()
    return found
