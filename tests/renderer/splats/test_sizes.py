"""Splats with radii of their own, drawn as the slow twin draws them, with all that a splat may have beside."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.splats.decoded import scene_radii
from renderer.splats.scene import GpuScene
from renderer.splats.stacks import has_stacks
from renderer.splats.upload.tables import group_boxes
from tests.renderer.reference_renderer import agreement_db, render
from tests.scenes import Settings, Splats, build_scene, camera_looking, coded, random_dictionary, sheet


def sizes(rng, n: int, low: float = 0.05, high: float = 0.3) -> np.ndarray:
    return low * (high / low) ** rng.random(n)


def assert_agrees(renderer, scene, view, least_covered: float = 0.1):
    gpu_scene = GpuScene(scene, renderer.context)
    picture = renderer.render(gpu_scene, view)
    gpu_scene.release()
    expected, covered = render(scene, view)
    assert covered.mean() >= least_covered
    assert (picture.coverage != covered).mean() < 1e-3
    assert agreement_db(picture.rgb, expected, lambda moved: render(scene, moved)[0], view) >= 45


@pytest.mark.parametrize("color_step", [0, 112])
@pytest.mark.parametrize("bits", [2, 3, 4])
def test_sizes__are_drawn_as_the_twin_does(renderer, bits, color_step):
    rng = np.random.default_rng(bits)
    scene = build_scene(
        sheet(rng, 200, size=sizes(rng, 200)), Settings(radius=0.1, size_bits=bits, color_step=color_step)
    )
    assert len(np.unique(scene_radii(scene))) > 2**bits  # two chunks with scales of their own
    assert_agrees(renderer, scene, camera_looking((0.3, -1.2, 0.4), (0, 0, 0)))


@pytest.mark.parametrize("distance", [1.0, 5.0, 20.0])
def test_sizes__of_atoms_cliplines_and_ellipsoids_count(renderer, distance):
    rng = np.random.default_rng(8)
    axes, line = np.tile(np.diag([0.12, 0.06, 0.03])[[0, 2, 1]], (150, 1, 1)), np.tile([0.8, 0.6, 0.1], (150, 1))
    axes[50:] = np.nan
    line[:100] = np.nan
    splats = sheet(rng, 150, size=sizes(rng, 150), axes=axes, clipline=line, **coded(rng, 150))
    scene = build_scene(splats, Settings(radius=0.1), random_dictionary(rng))
    view = camera_looking((0.2 * distance, -distance, 0.3), (0, 0, 0), (64, 48), (50 * distance**0.8,) * 2)
    assert_agrees(renderer, scene, view)


def test_sizes__the_margin_is_in_radii_of_the_splat_that_is_nearest(renderer):
    """Two discs 0.1 apart: the far one shows through a near one of 0.2 with a margin of a radius, not one of 0.05."""
    color = np.array([[255, 0, 0], [0, 0, 255]], np.uint8)
    for size, blends in ((0.2, True), (0.05, False)):
        position = np.array([[0.0, 0.0, 0.0], [0.0, 0.1, 0.0]])
        splats = Splats(position, np.tile([0.0, -1, 0], (2, 1)), color, size=np.array([size, 0.19]))
        scene = build_scene(splats, Settings(radius=0.1, depth_margin=0.1))
        gpu_scene = GpuScene(scene, renderer.context)
        view = camera_looking((0, -2, 0), (0, 0, 0))
        picture = renderer.render(gpu_scene, view)
        gpu_scene.release()
        middle = picture.rgb[int(view.cy_px), int(view.cx_px)]
        assert (middle[2] > 50) == blends and middle[0] > 100


def test_sizes__groups_reach_as_far_as_their_largest_splat():
    rng = np.random.default_rng(4)
    scene = build_scene(sheet(rng, 300, size=sizes(rng, 300)), Settings(radius=0.1))
    plain = replace(scene, header=replace(scene.header, size_bits=0, radius=scene_radii(scene).max()))
    np.testing.assert_allclose(group_boxes(scene), group_boxes(plain), atol=1e-6)


def test_sizes__copies_are_told_by_the_radii_of_their_chunk():
    """Scattered by a hundredth of the scan's radius, but by most of their own: no stack."""
    rng = np.random.default_rng(5)
    position = rng.uniform(-0.001, 0.001, (100, 3))
    small = Splats(position, np.tile([0.0, -1, 0], (100, 1)), size=np.full(100, 0.0015))
    assert not has_stacks(build_scene(small, Settings(radius=0.1)))
    assert has_stacks(build_scene(replace(small, size=None), Settings(radius=0.1)))
