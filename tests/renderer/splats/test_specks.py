"""A splat hides nothing at its rim, where it weighs next to nothing: pixels there show what lies behind."""

import numpy as np
import pytest

from renderer.splats.scene import GpuScene
from tests.scenes import Settings, Splats, build_scene, camera_looking

RIMS = {0.95: False, 0.75: False, 0.6: True, 0.2: True}  # by squared distance from the middle: whether it hides


@pytest.mark.parametrize(("d2", "hides"), RIMS.items())
def test_specks__a_rim_lets_what_lies_behind_through(renderer, d2, hides):
    """A small red disc far before a large blue one, looked at so that a pixel's centre falls on its rim."""
    position = np.array([[0.0, 0.0, 0.0], [0.0, 5.0, 0.0]])
    color = np.array([[255, 0, 0], [0, 0, 255]], np.uint8)
    splats = Splats(position, np.tile([0.0, -1, 0], (2, 1)), color, size=np.array([0.5, 1.9]))
    scene = build_scene(splats, Settings(radius=0.5, depth_margin=0.1))
    view = camera_looking((0, -4, 0), (0, 0, 0), (96, 96), (400.0, 400.0))
    gpu_scene = GpuScene(scene, renderer.context)
    picture = renderer.render(gpu_scene, view)
    gpu_scene.release()
    at = int(view.cx_px + 400 * 0.5 / 4 * d2**0.5) if d2 < 0.9 else int(view.cx_px + 400 * 0.5 / 4 * 0.975)
    red, _, blue = picture.rgb[int(view.cy_px), min(at, 95)].tolist()
    assert picture.coverage[int(view.cy_px), min(at, 95)]
    assert red > 0 and (blue == 0) == hides


def test_specks__a_far_slanted_surface_has_the_mean_of_what_lies_on_a_pixel(renderer):
    """Forty thousand splats of a quarter of a pixel, black or white by chance, seen at 78 degrees: all on a pixel colour
    it, not only the nearest of them."""
    across, along = (axis.ravel() for axis in np.mgrid[-100:100, -100:100])
    position = np.column_stack([0.01 * across, 0.01 * along, np.zeros(len(across))])
    color = np.repeat(np.random.default_rng(3).integers(0, 2, (len(across), 1)) * 255, 3, axis=1).astype(np.uint8)
    scene = build_scene(
        Splats(position, np.tile([0.0, 0, 1], (len(across), 1)), color), Settings(radius=0.011, depth_margin=0.011)
    )
    gpu_scene = GpuScene(scene, renderer.context)
    view = camera_looking((0, -9.8, 2), (0, 0, 0), (64, 48), (225.0, 225.0))
    rgb = renderer.render(gpu_scene, view).rgb[22:26, 20:44, 0].astype(float)
    gpu_scene.release()
    assert rgb.std() < 15  # of the nearest alone 20
    assert abs(rgb.mean() - 188) < 6  # half of white in linear light
