"""Splats that show their backs, left out: all of them, and none that faces the viewer."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.splats.decoded import scene_bounds
from renderer.splats.scene import DRAWS, GpuScene
from renderer.splats.upload.tables import group_cones
from tests.runs import on_runs
from tests.scenes import Settings, Splats, build_scene, camera_looking, sheet

VIEWS = (*np.eye(3), *-np.eye(3))


def directions(n: int) -> np.ndarray:
    """Spread evenly over the sphere, (n, 3) unit."""
    z = 1 - (2 * np.arange(n) + 1) / n
    angle = np.pi * (1 + 5**0.5) * np.arange(n)
    rho = np.sqrt(1 - z**2)
    return np.stack([rho * np.cos(angle), rho * np.sin(angle), z], axis=1)


def pictures(renderer, scene, view):
    found = []
    for front in (False, True):
        gpu_scene = GpuScene(scene, renderer.context, front_only=front)
        found.append(renderer.render(gpu_scene, view))
        gpu_scene.release()
    return found


def ball_of_specks(n: int = 300, radius: float = 0.02) -> tuple[Splats, Settings]:
    """Discs far apart on a sphere, so that most pixels show at most one of each side; red ones look along +x."""
    normal = directions(n)
    return Splats(normal, normal, np.full((n, 3), 200, np.uint8)), Settings(radius=radius)


@pytest.mark.parametrize("towards", VIEWS, ids=["x", "y", "z", "-x", "-y", "-z"])
def test_front__leaves_out_more_than_a_third_of_a_ball_and_none_that_faces_the_viewer(renderer, towards):
    splats, settings = ball_of_specks()
    scene = build_scene(splats, settings=settings)
    up = (0, 0, 1) if towards[2] == 0 else (1, 0, 0)
    eye = 6.0 * towards
    view = camera_looking(eye, (0, 0, 0), (700, 700), (1800.0, 1800.0), up)
    both, front = pictures(renderer, scene, view)
    camera = (splats.position - view.centre) @ np.array(view.rotation).T
    pixel = (camera[:, :2] / camera[:, 2:] * [view.fx_px, view.fy_px] + [view.cx_px, view.cy_px]).astype(int)
    away = ((splats.position - view.centre) * splats.normal).sum(axis=1)
    alone = np.abs(away / 6) > 0.05  # not on the outline, where the packed normal decides
    facing = away < 0
    hidden = ~facing & ~near_another(pixel, facing)
    assert (~facing).mean() > 0.3 and hidden.sum() > 50
    shown = seen(front, pixel)
    assert shown[facing & alone].all() and not shown[hidden & alone].any()
    assert seen(both, pixel)[alone].all()


def seen(picture, pixel: np.ndarray) -> np.ndarray:
    """Whether something is drawn within a pixel of each place."""
    column, row = pixel.T
    return np.any([picture.coverage[row + j, column + i] > 0 for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0)


def near_another(pixel: np.ndarray, facing: np.ndarray, px: int = 14) -> np.ndarray:
    """Which lie behind a disc that faces the viewer."""
    off = np.abs(pixel[:, None] - pixel[None, facing]).max(axis=2)
    return (off < px).any(axis=1)


def test_front__a_closed_ball_looks_the_same_and_a_sheet_is_gone_from_behind(renderer):
    normal = directions(6000)
    color = np.rint(127 + 100 * normal).astype(np.uint8)
    view = camera_looking((0, -4, 0), (0, 0, 0), (300, 300), (500.0, 500.0))
    both, front = pictures(renderer, build_scene(Splats(normal, normal, color), settings=Settings(radius=0.05)), view)
    assert (both.coverage != front.coverage).mean() < 0.005 and (
        np.abs(both.rgb.astype(int) - front.rgb) > 2
    ).mean() < 0.005
    x, z = np.meshgrid(np.linspace(-1, 1, 40), np.linspace(-1, 1, 40))
    place = np.stack([x.ravel(), 0 * x.ravel(), z.ravel()], axis=1)
    for side, is_seen in ((1.0, False), (-1.0, True)):
        sheet = build_scene(Splats(place, np.tile([0.0, side, 0.0], (1600, 1))), settings=Settings(radius=0.05))
        both, front = pictures(renderer, sheet, view)
        assert both.coverage.mean() > 0.2
        assert np.array_equal(both.rgb, front.rgb) if is_seen else not front.coverage.any()


def test_front__groups_of_runs_are_left_out_by_their_cones(renderer):
    rng = np.random.default_rng(0)
    scene = on_runs(build_scene(sheet(rng, 9000)))  # a wavy sheet across z
    low, high = scene_bounds(scene)
    middle = (low.min(axis=0) + high.max(axis=0)) / 2
    axis = group_cones(scene)[:, :3].mean(axis=0)
    assert (group_cones(scene)[:, 3] > 0.5).all()
    for side, is_drawn in ((1.0, True), (-1.0, False)):
        eye = middle + 60 * side * axis
        view = camera_looking(eye, middle, (200, 200), (200.0, 200.0), (0.0, 1.0, 0.1))
        gpu_scene = GpuScene(scene, renderer.context, front_only=True)
        picture = renderer.render(gpu_scene, view)
        with renderer.context:
            draws = np.frombuffer(gpu_scene.buffers[DRAWS].read(), np.uint32).reshape(-1, 5)
        gpu_scene.release()
        assert (draws[:, 0] > 0).all() == is_drawn and draws[:, 0].any() == is_drawn
        assert picture.coverage.any() == is_drawn
