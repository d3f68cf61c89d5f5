"""Ellipsoids in the GL renderer: against rays in float64, and what is compiled and drawn for them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from renderer.splats.baseline import PhotoSplats
from renderer.splats.scene import DRAWS, GpuScene
from renderer.splats.upload.tables import group_boxes
from storage.packed.schema import GROUP, MAX_ATOMS
from tests.renderer.reference_renderer import psnr_db, render, render_baseline
from tests.renderer.splats.test_baseline import smooth_photo
from tests.renderer.splats.test_renderer import assert_agrees, drawn
from tests.scenes import Settings, Splats, build_scene, camera_looking, coded, random_colors, random_dictionary, sheet

RADIUS = 0.1


def cloud(rng, n, discs=0.3, smallest=0.2, longest=3.0, half_width=0.5, **more):
    """Ellipsoids of all shapes and some discs, scattered in a cube."""
    lengths = RADIUS * np.exp(rng.uniform(np.log(smallest), np.log(longest), (n, 3)))
    axes = Rotation.random(n, rng).as_matrix() * lengths[..., None]
    normal = axes[:, 2] / lengths[:, 2:]
    axes[rng.random(n) < discs] = np.nan
    return Splats(rng.uniform(-half_width, half_width, (n, 3)), normal, random_colors(rng, n), axes=axes, **more)


@pytest.mark.parametrize("distance", [0.9, 2.0, 20.0])
def test_ellipsoids__are_drawn_as_rays_meet_them(renderer, distance):
    rng = np.random.default_rng(0)
    view = camera_looking((0.3 * distance, -distance, 0.2 * distance), (0, 0, 0), (64, 48), (50 * distance,) * 2)
    picture = assert_agrees(renderer, build_scene(cloud(rng, 50), Settings(radius=RADIUS)), view, least_covered=0.2)
    assert any("ellipsoid" in name for name in picture.programs)


@pytest.mark.parametrize("distance", [1.2, 8.0])
def test_ellipsoids__take_their_colour_from_the_square_of_their_first_two_axes(renderer, distance):
    rng = np.random.default_rng(1)
    scene = build_scene(cloud(rng, 40, **coded(rng, 40)), Settings(radius=RADIUS), random_dictionary(rng))
    assert_agrees(renderer, scene, camera_looking((0.3, -distance, 0.2), (0, 0, 0), (64, 48), (55 * distance,) * 2))


def test_ellipsoids__stand_beside_discs_with_cliplines(renderer):
    rng = np.random.default_rng(2)
    n = 80
    splats = cloud(rng, n, **coded(rng, n))
    angle = rng.uniform(0, 2 * np.pi, n)
    line = np.column_stack([np.cos(angle), np.sin(angle), rng.uniform(-0.6, 0.6, n)])
    line[~np.isnan(splats.axes[:, 0, 0]) | (rng.random(n) < 0.3)] = np.nan
    splats = Splats(**{**splats.__dict__, "clipline": line})
    scene = build_scene(splats, Settings(radius=RADIUS), random_dictionary(rng))
    assert {(b.clipline, b.ellipsoid) for b in scene.header.batches} == {(False, False), (True, False), (False, True)}
    assert_agrees(renderer, scene, camera_looking((0.3, -1.4, 0.2), (0, 0, 0)))


def test_ellipsoids__are_told_from_discs_beyond_the_32nd_batch(renderer):
    rng = np.random.default_rng(4)
    n = 300
    splats = cloud(rng, n, **coded(rng, n, max_atoms=MAX_ATOMS))
    angle = rng.uniform(0, 2 * np.pi, n)
    line = np.column_stack([np.cos(angle), np.sin(angle), rng.uniform(0.3, 0.9, n)])
    line[~np.isnan(splats.axes[:, 0, 0]) | (rng.random(n) < 0.5)] = np.nan
    splats = Splats(**{**splats.__dict__, "clipline": line})
    scene = build_scene(splats, Settings(radius=RADIUS, color_step=100), random_dictionary(rng))
    assert sum(b.ellipsoid for b in scene.header.batches[32:]) >= 15
    assert_agrees(renderer, scene, camera_looking((0.3, -1.4, 0.2), (0, 0, 0)))


@pytest.mark.parametrize("distance", [3.0, 30.0])
def test_ellipsoids__thinner_than_a_pixel_still_cover_one(renderer, distance):
    """A wire of needles, far away: no gap in it."""
    n = 60
    position = np.column_stack([np.linspace(-0.5, 0.5, n), np.zeros((n, 2))])
    axes = np.tile(np.diag([0.05, 0.002, 0.002]), (n, 1, 1))
    splats = Splats(position, np.tile([0.0, 0, 1], (n, 1)), random_colors(np.random.default_rng(3), n), axes=axes)
    scene = build_scene(splats, Settings(radius=RADIUS))
    picture = assert_agrees(
        renderer,
        scene,
        camera_looking((0, -distance, 0), (0, 0, 0), focal_px=(60 * distance / 2,) * 2),
        least_covered=0.005,
    )
    columns = picture.coverage.any(axis=0)
    assert columns[np.flatnonzero(columns)[0] : np.flatnonzero(columns)[-1] + 1].all() and columns.sum() >= 28


def test_ellipsoids__a_round_one_is_a_ball_from_everywhere_and_a_flat_one_a_disc(renderer):
    ball = np.tile(np.eye(3) * RADIUS, (1, 1, 1))
    flat = ball * np.array([1, 1, 1 / 60])[None, :, None]
    view = {"size": (96, 96), "focal_px": (300.0, 300.0)}
    normal = np.array([[0.0, 0.0, 1.0]])
    disc = drawn(
        renderer,
        build_scene(Splats(np.zeros((1, 3)), normal), Settings(radius=RADIUS)),
        camera_looking((0.01, 0, 1), (0, 0, 0), **view),
    ).coverage.sum()
    for eye in ((0.01, 0, 1), (1, 0, 0), (0.5, -0.6, 0.6)):
        look = camera_looking(np.array(eye) / np.linalg.norm(eye), (0, 0, 0), **view)
        seen = [
            drawn(
                renderer, build_scene(Splats(np.zeros((1, 3)), normal, axes=axes), Settings(radius=RADIUS)), look
            ).coverage.sum()
            for axes in (ball, flat)
        ]
        assert abs(seen[0] / (np.pi * (300 * RADIUS) ** 2 / (1 - RADIUS**2)) - 1) < 0.02
        assert abs(seen[1] - disc * abs(look.centre[2])) < 0.05 * disc  # edge on it still covers a pixel's width


def test_ellipsoids__hide_each_other_by_the_depth_of_their_surface(renderer):
    """A ball in front of a needle that points at the eye: at the needle's place the ball's front is seen, beside it the
    needle."""
    axes = np.stack([np.eye(3) * 0.1, np.diag([0.05, 0.05, 0.3])])
    color = np.array([[250, 10, 10], [10, 250, 10]], np.uint8)
    splats = Splats(np.array([[0, 0, 0.35], [0.08, 0, 0.0]]), np.tile([0.0, 0, 1], (2, 1)), color, axes=axes)
    scene = build_scene(splats, Settings(radius=RADIUS, depth_margin=0.0))
    picture = assert_agrees(renderer, scene, camera_looking((0, -0.001, 3), (0, 0, 0.2), (80, 80), (600, 600)))
    red, green = ((picture.rgb[..., i] > 200) & picture.coverage for i in (0, 1))
    assert red.sum() > 500 and green.sum() > 50


def test_ellipsoids__around_the_eye_are_not_drawn_and_nothing_breaks(renderer):
    rng = np.random.default_rng(4)
    scene = build_scene(cloud(rng, 60, discs=0, half_width=0.25), Settings(radius=RADIUS))
    picture = drawn(renderer, scene, camera_looking((0, 0, 0), (1, 0, 0.1)))
    expected, covered = render(scene, camera_looking((0, 0, 0), (1, 0, 0.1)))
    assert covered.any() and (picture.coverage != covered).mean() < 0.02
    assert psnr_db(picture.rgb / 255, expected) >= 30  # triangles cut by the near plane


def test_ellipsoids__do_not_jitter_far_from_the_origin(renderer):
    rng = np.random.default_rng(5)
    origin = np.array([4.5e5, 5.4e6, 100.0])
    near = cloud(rng, 40)
    splats = Splats(near.position + origin, near.normal, near.color, axes=near.axes)
    scene = build_scene(splats, Settings(radius=RADIUS, origin=tuple(origin)))
    assert_agrees(renderer, scene, camera_looking(np.add((0.3, -1.2, 0.4), origin), origin))


def test_ellipsoids__keep_their_outline_a_kilometre_away(renderer):
    rng = np.random.default_rng(6)
    scene = build_scene(cloud(rng, 30, discs=0, smallest=0.05), Settings(radius=RADIUS))
    assert_agrees(renderer, scene, camera_looking((100, -1000, 50), (0, 0, 0), (64, 48), (4e4, 4e4)), least_covered=0.2)


def test_ellipsoids__of_several_groups_are_all_found(renderer):
    rng = np.random.default_rng(7)
    n = GROUP + 600
    splats = cloud(rng, n, discs=0.5, smallest=0.05, longest=0.2, half_width=0.8)
    scene = build_scene(splats, Settings(radius=RADIUS))
    assert scene.header.n_groups == 2
    assert_agrees(renderer, scene, camera_looking((0.1, -3, 0.2), (0, 0, 0), (24, 18), (24, 22)), least_covered=0.3)


def test_ellipsoids__a_group_is_drawn_as_long_as_its_longest_reaches_into_view(renderer):
    axes = np.diag([4.0, 0.5, 0.5])[None] * RADIUS
    scene = build_scene(Splats(np.zeros((1, 3)), np.array([[0.0, 0, 1]]), axes=axes), Settings(radius=RADIUS))
    assert group_boxes(scene)[0, 3] >= 0.4
    gpu_scene = GpuScene(scene, renderer.context)
    picture = renderer.render(gpu_scene, camera_looking((0.62, -1, 0), (0.62, 0, 0), (40, 40), (70, 70)))
    with renderer.context:
        n_indices = np.frombuffer(gpu_scene.buffers[DRAWS].read(), np.uint32)[0]
    gpu_scene.release()
    assert picture.coverage.any() and n_indices == 3


def test_ellipsoids__the_baseline_looks_each_fragment_up_in_its_photograph(renderer):
    rng = np.random.default_rng(8)
    cameras = (
        camera_looking((0.4, -1.3, 0.3), (0, 0, 0), (96, 64), (80, 95), name="a"),
        camera_looking((-0.5, -1.4, -0.2), (0, 0, 0), (64, 128), (110, 90), name="b"),
    )
    photos = [smooth_photo(rng, (c.width_px, c.height_px)) for c in cameras]
    scene = build_scene(cloud(rng, 60, camera=rng.choice([0, 1, 0xFFFF], 60)), Settings(radius=RADIUS, cameras=cameras))
    view = camera_looking((0.1, -1.5, 0.2), (0, 0, 0), (64, 48), (50, 48))
    gpu_scene = GpuScene(scene, renderer.context)
    splats = PhotoSplats(gpu_scene, photos.__getitem__)
    picture = renderer.render_baseline(splats, view)
    splats.release()
    gpu_scene.release()
    expected, covered = render_baseline(scene, photos, view)
    assert covered.mean() > 0.2 and (picture.coverage != covered).mean() < 1e-3
    assert psnr_db(picture.rgb / 255, expected) >= 45


def test_ellipsoids__where_there_are_none_no_shader_knows_of_them(renderer):
    scene = build_scene(sheet(np.random.default_rng(9), 20))
    gpu_scene = GpuScene(scene, renderer.context)
    picture = renderer.render(gpu_scene, camera_looking((0.3, -1.2, 0.4), (0, 0, 0)))
    assert not gpu_scene.has_ellipsoids and not any("ellipsoid" in name for name in picture.programs)
    gpu_scene.release()
