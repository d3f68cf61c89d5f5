"""Pictures drawn larger than they are, of which each pixel is the mean."""

import numpy as np
import pytest

from pipeline.numerics.srgb import LINEAR_OF_LEVEL, srgb_of
from renderer.pictures import on_background
from renderer.splats.projection import larger
from renderer.splats.renderer import Renderer
from renderer.splats.scene import GpuScene
from tests.scenes import Settings, Splats, build_scene, camera_looking

SIZE = (48, 36)


@pytest.fixture(scope="module")
def scene():
    """Three hundred discs of any colour, size and side."""
    rng = np.random.default_rng(4)
    normal = rng.normal(size=(300, 3))
    splats = Splats(
        rng.uniform(-1, 1, (300, 3)),
        normal / np.linalg.norm(normal, axis=1, keepdims=True),
        rng.integers(0, 256, (300, 3)).astype(np.uint8),
        size=rng.uniform(0.02, 0.3, 300),
    )
    return build_scene(splats, Settings(radius=0.1, depth_margin=0.1))


@pytest.mark.parametrize("times", [2, 3])
def test_antialias__a_pixel_is_the_mean_of_its_parts_that_are_covered(renderer, scene, times):
    view = camera_looking((0, -4, 0.3), (0, 0, 0), SIZE, (50.0, 50.0))
    fine, smooth = GpuScene(scene, renderer.context), Renderer(renderer.context, antialias=times)
    picture, large = smooth.render(fine, view), renderer.render(fine, larger(view, times))
    fine.release()
    parts = SIZE[1], times, SIZE[0], times
    n = large.coverage.reshape(parts).sum(axis=(1, 3))
    light = (LINEAR_OF_LEVEL[large.rgb] * large.coverage[..., None]).reshape(*parts, 3).sum(axis=(1, 3))
    expected = 255 * srgb_of(light / np.maximum(n, 1)[..., None])
    assert picture.rgb.shape == (*SIZE[::-1], 3) and 0.2 < (n > 0).mean() < 0.9
    assert np.abs(picture.rgb - expected).max() <= 1.5  # both are rounded
    assert np.abs(picture.alpha - 255 * n / times**2).max() <= 2 and (picture.alpha[n == 0] == 0).all()
    assert (picture.coverage == (2 * n >= times**2)).all()


def test_antialias__what_is_too_large_for_the_driver_is_drawn_as_it_is(renderer):
    most, smooth = renderer.context.info["GL_MAX_TEXTURE_SIZE"], Renderer(renderer.context, antialias=4)
    view = camera_looking((0, -4, 0), (0, 0, 0), (most // 3, 20), (50.0, 50.0))
    assert smooth.times_of(view) == 3
    assert smooth.times_of(camera_looking((0, -4, 0), (0, 0, 0), (20, most), (50.0, 50.0))) == 1


def test_background__rims_mix_with_it_in_linear_light():
    rgb, alpha = np.full((1, 3, 3), 255, np.uint8), np.array([[0, 128, 255]], np.uint8)
    assert on_background(rgb, alpha)[0, :, 3].tolist() == [0, 128, 255]
    assert on_background(rgb, alpha, (0, 0, 0))[0, :, 0].tolist() == [0, 188, 255]
