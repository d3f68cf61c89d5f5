"""The GL renderer against its slow twin, and what it promises of hard views."""

from dataclasses import replace

import numpy as np
import pytest

from renderer.splats.scene import DRAWS, GpuScene
from storage.packed.schema import GROUP, MAX_ATOMS
from tests.renderer.reference_renderer import agreement_db, psnr_db, render
from tests.scenes import (
    Dictionary,
    Settings,
    Splats,
    build_scene,
    camera_looking,
    coded,
    random_colors,
    random_dictionary,
    sheet,
)


def drawn(renderer, scene, view, max_atoms=MAX_ATOMS):
    gpu_scene = GpuScene(scene, renderer.context)
    picture = renderer.render(gpu_scene, view, max_atoms)
    gpu_scene.release()
    return picture


def assert_agrees(renderer, scene, view, max_atoms=MAX_ATOMS, least_covered=0.05):
    picture = drawn(renderer, scene, view, max_atoms)
    expected, covered = render(scene, view, max_atoms)
    assert covered.mean() >= least_covered
    assert (picture.coverage != covered).mean() < 1e-3
    assert agreement_db(picture.rgb, expected, lambda moved: render(scene, moved, max_atoms)[0], view) >= 45
    return picture


def test_renderer__draws_plain_discs_as_the_twin_does(renderer):
    rng = np.random.default_rng(0)
    assert_agrees(renderer, build_scene(sheet(rng, 60)), camera_looking((0.3, -1.2, 0.4), (0, 0, 0)), least_covered=0.3)


@pytest.mark.parametrize("max_atoms", range(MAX_ATOMS + 1))
def test_renderer__draws_every_atom_count(renderer, max_atoms):
    rng = np.random.default_rng(1)
    splats = sheet(rng, 110, **coded(rng, 110, max_atoms=MAX_ATOMS))
    scene = build_scene(splats, Settings(radius=0.2), random_dictionary(rng))
    view = camera_looking((0.2, -1.0, 0.3), (0, 0, 0), (72, 40), (50, 55))
    picture = assert_agrees(renderer, scene, view, max_atoms, least_covered=0.3)
    used = {int(name.split("atoms=")[1].split()[0]) for name in picture.programs if "atoms=" in name}
    assert used == set(range(max_atoms + 1))


@pytest.mark.parametrize(("bits", "n_dictionary", "weight_bits"), [(12, 300, 4), (16, 300, 8), (5, 20, 3)])
def test_renderer__reads_codes_of_every_width(renderer, bits, n_dictionary, weight_bits):
    rng = np.random.default_rng(2)
    splats = sheet(rng, 140, **coded(rng, 140, n_dictionary, weight_bits))
    dictionary = random_dictionary(rng, n_dictionary, weight_bits, bits)
    scene = build_scene(splats, Settings(radius=0.2), dictionary)
    assert_agrees(renderer, scene, camera_looking((0, -1, 0.2), (0, 0, 0)))


def test_renderer__reads_codes_where_all_plain_splats_have_as_many_atoms(renderer):
    """Their batch leads, and others follow in each chunk, whose rows are none of its codes'."""
    rng = np.random.default_rng(5)
    n = 3 * GROUP // 2
    line = np.where(rng.random((n, 1)) < 0.5, [0.6, 0.8, 0.3], np.nan)
    codes = coded(rng, n, max_atoms=1) | {"n_atoms": np.ones(n, int)}
    scene = build_scene(sheet(rng, n, clipline=line, **codes), Settings(radius=0.03), random_dictionary(rng))
    assert [(batch.n_atoms, batch.clipline) for batch in scene.header.batches] == [(1, False), (1, True)]
    assert_agrees(renderer, scene, camera_looking((0, -1, 0.2), (0, 0, 0)))


@pytest.mark.parametrize("blended", [False, True])
@pytest.mark.parametrize("distance", [0.5, 1.5, 3.0, 8.0, 25.0])
def test_renderer__draws_every_mip_level(renderer, distance, blended):
    rng = np.random.default_rng(3)
    scene = build_scene(sheet(rng, 120, **coded(rng, 120)), Settings(radius=0.15), random_dictionary(rng))
    scene = replace(scene, header=replace(scene.header, effects={"level_blending": {}} if blended else {}))
    view = camera_looking((0.1 * distance, -distance, 0), (0, 0, 0), (64, 48), (50 * distance**0.7, 45 * distance**0.7))
    picture = assert_agrees(renderer, scene, view)
    assert any("blended" in name.split() for name in picture.programs) == blended


@pytest.mark.parametrize(("size", "distance"), [(8, 0.5), (8, 8.0), (16, 1.0), (16, 3.0), (32, 0.5)])
def test_renderer__turns_atoms_of_every_size(renderer, size, distance):
    rng = np.random.default_rng(23)
    whole = random_dictionary(rng)
    means = whole.atoms.reshape(20, size, 32 // size, size, 32 // size, 3).mean(axis=(2, 4)).round().astype(np.int8)
    dictionary = Dictionary(means, whole.scale, whole.weight_levels, n_turns=8)
    scene = build_scene(sheet(rng, 120, **coded(rng, 120, 8 * 20)), Settings(radius=0.15), dictionary)
    view = camera_looking((0.1 * distance, -distance, 0), (0, 0, 0), (64, 48), (50 * distance**0.7, 45 * distance**0.7))
    picture = assert_agrees(renderer, scene, view)
    assert any("turned" in name for name in picture.programs)


def test_renderer__turns_the_atoms_of_every_rank(renderer):
    rng = np.random.default_rng(29)
    whole = random_dictionary(rng)
    dictionary = Dictionary(whole.atoms, whole.scale, np.full_like(whole.weight_levels, 0.4), n_turns=8)
    codes = coded(rng, 60, 8 * 20, max_atoms=MAX_ATOMS) | {"n_atoms": np.full(60, MAX_ATOMS)}
    scene = build_scene(sheet(rng, 60, **codes), Settings(radius=0.2), dictionary)
    assert_agrees(renderer, scene, camera_looking((0.1, -0.7, 0.1), (0, 0, 0)), least_covered=0.3)


@pytest.mark.parametrize(("step", "n"), [(80, 60), (112, 140), (140, 300), (255, 140)])
def test_renderer__draws_colours_in_boxes_as_the_twin_does(renderer, step, n):
    rng = np.random.default_rng(31)
    line = np.tile([0.8, 0.6, 0.1], (n, 1))
    line[rng.random(n) < 0.6] = np.nan
    splats = sheet(rng, n, clipline=line, **coded(rng, n, max_atoms=2))
    splats = replace(
        splats,
        color=np.concatenate([splats.color[: n // 2], 100 + rng.integers(0, 9, (n - n // 2, 3))]).astype(np.uint8),
    )
    scene = build_scene(splats, Settings(radius=0.15, color_step=step), random_dictionary(rng))
    picture = assert_agrees(renderer, scene, camera_looking((0.3, -1.2, 0.4), (0, 0, 0)), least_covered=0.3)
    assert all("color boxes" in name for name in picture.programs if name.startswith(("visibility", "attribute")))


@pytest.mark.parametrize("step", [80, 112, 144])
def test_renderer__decodes_colours_in_boxes_to_the_level(renderer, step):
    rng = np.random.default_rng(41)
    splats = replace(sheet(rng, 150), color=rng.integers(0, 256, (150, 3)).astype(np.uint8))
    scene, view = build_scene(splats, Settings(color_step=step)), camera_looking((0.3, -1.2, 0.4), (0, 0, 0))
    picture, (expected, covered) = drawn(renderer, scene, view), render(scene, view)
    apart = np.abs(picture.rgb - 255 * expected)[covered & picture.coverage]
    assert np.percentile(apart, 98) <= 0.6  # but at the rims of discs: the rounding of a picture's bytes


def test_renderer__colours_in_boxes_change_no_more_than_half_a_cell(renderer):
    rng = np.random.default_rng(37)
    splats, view = sheet(rng, 200), camera_looking((0.3, -1.2, 0.4), (0, 0, 0))
    plain, boxed = (
        drawn(renderer, build_scene(splats, Settings(color_step=step)), view).rgb.astype(int) for step in (0, 112)
    )
    assert 0 < np.abs(plain - boxed).max() <= 3


@pytest.mark.parametrize("distance", [1.0, 4.0, 10.0])
def test_renderer__does_not_mix_in_the_neighbours_of_an_atom(renderer, distance):
    rng = np.random.default_rng(17)
    atoms = np.full((9, 32, 32, 3), -127, np.int8)
    atoms[4] = 127  # the middle one of a grid of 3 x 3
    ones = np.ones((60, 8), int)
    dictionary = Dictionary(atoms, np.full(9, 0.3 / 127, np.float32), np.ones((8, 16), np.float32))
    plain = sheet(rng, 60)
    splats = Splats(plain.position, plain.normal, np.full((60, 3), 128, np.uint8), ones[:, 0], 4 * ones, ones)
    scene = build_scene(splats, Settings(radius=0.2), dictionary)
    picture = drawn(renderer, scene, camera_looking((0, -distance, 0), (0, 0, 0)))
    assert picture.coverage.any()
    assert np.abs(picture.rgb[picture.coverage] - (128 + 0.3 * 255)).max() <= 1.5


@pytest.mark.parametrize("side", [-1, 1])
def test_renderer__draws_splats_seen_almost_edge_on(renderer, side):
    rng = np.random.default_rng(18)
    n = 40
    angle = rng.uniform(0, 2 * np.pi, n)
    line = np.column_stack([np.cos(angle), np.sin(angle), rng.uniform(-0.2, 0.2, n)])
    position = np.column_stack([rng.uniform(-1, 1, n), np.linspace(-1.2, 1.2, n), np.zeros(n)])
    normal = np.array([0.0, 0.0, 1.0]) + rng.normal(0, 0.02, (n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    splats = Splats(position, normal, random_colors(rng, n), clipline=line, **coded(rng, n))
    scene = build_scene(splats, Settings(radius=0.3), random_dictionary(rng))
    view = camera_looking((0, -5, 0.25 * side), (0, 0, 0), (160, 40), (200, 200))
    assert_agrees(renderer, scene, view, least_covered=0.02)


def test_renderer__cuts_at_cliplines(renderer):
    rng = np.random.default_rng(4)
    n = 150
    angle = rng.uniform(0, 2 * np.pi, n)
    line = np.column_stack([np.cos(angle), np.sin(angle), rng.uniform(-0.6, 0.6, n)])
    line[rng.random(n) < 0.4] = np.nan
    splats = sheet(rng, n, clipline=line, **coded(rng, n, max_atoms=3))
    scene = build_scene(splats, Settings(radius=0.12), random_dictionary(rng))
    view = camera_looking((0.2, -1.1, 0.3), (0, 0, 0))
    picture = assert_agrees(renderer, scene, view)
    whole = build_scene(Splats(splats.position, splats.normal, splats.color), Settings(radius=0.12))
    assert drawn(renderer, whole, view).coverage.sum() > picture.coverage.sum()


def test_renderer__hides_what_lies_behind_the_margin_and_blends_what_lies_within(renderer):
    rng = np.random.default_rng(5)
    layers = [sheet(rng, 80, tilt=0.02) for _ in range(3)]
    position = np.concatenate([layer.position + [0, y, 0] for layer, y in zip(layers, (0, 0.02, 0.5), strict=True)])
    color = np.repeat([[220, 30, 30], [30, 220, 30], [30, 30, 220]], 80, axis=0).astype(np.uint8)
    scene = build_scene(Splats(position, np.concatenate([layer.normal for layer in layers]), color))
    view = camera_looking((0.0, -1.0, 0.05), (0, 0, 0), (64, 48), (90, 90))
    picture = assert_agrees(renderer, scene, view)
    middle = picture.rgb[20:28, 28:36].reshape(-1, 3).mean(axis=0)
    assert middle[0] > 100 and middle[1] > 100 and middle[2] < 60


def test_renderer__finds_every_splat_of_several_groups(renderer):
    rng = np.random.default_rng(6)
    n = GROUP + 700
    splats = sheet(rng, n, half_width=1.0, **coded(rng, n))
    scene = build_scene(splats, Settings(radius=0.02), random_dictionary(rng))
    assert scene.header.n_groups == 2
    assert_agrees(renderer, scene, camera_looking((0.1, -1.2, 0.2), (0, 0, 0), (48, 36), (24, 22)), least_covered=0.5)


def test_renderer__culls_groups_out_of_view_and_no_others(renderer):
    rng = np.random.default_rng(7)
    n = 2 * GROUP
    splats = sheet(rng, n, half_width=1.0)
    wide = Splats(splats.position * [2, 1, 1], splats.normal, splats.color)
    scene = build_scene(wide, Settings(radius=0.02))
    gpu_scene = GpuScene(scene, renderer.context)
    view = camera_looking((-0.9, -0.3, 0.0), (-0.9, 0, 0.0), (30, 30), (90, 90))
    picture = renderer.render(gpu_scene, view)
    with renderer.context:
        draws = np.frombuffer(gpu_scene.buffers[DRAWS].read(), np.uint32).reshape(2, scene.header.n_groups, 5)
    gpu_scene.release()
    assert sorted(draws[0, :, 0]) == [0, 3 * GROUP]
    expected, _ = render(scene, view)
    assert psnr_db(picture.rgb / 255, expected) >= 45


def test_renderer__survives_splats_behind_the_camera_at_its_plane_and_around_the_eye(renderer):
    rng = np.random.default_rng(8)
    n = 300
    position = rng.uniform(-1, 1, (n, 3))
    position[:20] = 0.0
    normal = rng.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    scene = build_scene(Splats(position, normal, random_colors(rng, n)), Settings(radius=0.15))
    inside = drawn(renderer, scene, camera_looking((0, 0, 0), (1, 0, 0)))
    assert inside.coverage.mean() > 0.5
    apart = np.linalg.norm(position, axis=1) > 0.4
    scene = build_scene(Splats(position[apart], normal[apart], random_colors(rng, apart.sum())), Settings(radius=0.15))
    assert_agrees(renderer, scene, camera_looking((0, 0, 0), (1, 0.2, 0.1), focal_px=(30, 40)), least_covered=0.3)


def test_renderer__gives_every_visible_splat_a_pixel(renderer):
    rng = np.random.default_rng(9)
    grid = np.stack(np.meshgrid(np.arange(8), np.arange(6)), axis=-1).reshape(-1, 2)
    position = np.column_stack([grid[:, 0] - 3.5, np.zeros(48), grid[:, 1] - 2.5]) + rng.uniform(-0.2, 0.2, (48, 3))
    normal = rng.normal(size=(48, 3))
    normal[:16] = np.array([1.0, 0, 0])  # edge on
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    scene = build_scene(Splats(position, normal, random_colors(rng, 48)), Settings(radius=0.01))
    view = camera_looking((0, -10, 0), (0, 0, 0), (80, 60), (90, 90))
    picture = assert_agrees(renderer, scene, view, least_covered=48 / 4800)
    from skimage.measure import label

    assert label(picture.coverage).max() == 48


@pytest.mark.parametrize(
    ("up", "ahead"),
    [((1, 0, 0), (0, 1, 0)), ((0, 1, 0), (0, 0, 1)), ((0, 0, 1), (1, 0, 0)), ((-5, -35, 6), (1, 5, 30))],
)
def test_renderer__turns_texels_as_the_tangent_frame_says(renderer, up, ahead):
    rng = np.random.default_rng(10)
    normal = rng.normal(size=(60, 3))
    normal[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    splats = Splats(normal * 0.8, normal, random_colors(rng, 60), **coded(rng, 60))
    scene = build_scene(splats, Settings(radius=0.35, up=up, ahead=ahead, depth_margin=0.1), random_dictionary(rng))
    for eye in ((2.5, 0.4, 0.3), (-0.3, 2.4, 1.0), (0.5, -0.2, -2.6)):
        assert_agrees(renderer, scene, camera_looking(eye, (0, 0, 0)))


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_renderer__draws_the_same_picture_at_every_scale(renderer, scale):
    rng = np.random.default_rng(11)
    splats = sheet(rng, 80)
    scaled = Splats(splats.position * scale, splats.normal, splats.color)
    scene = build_scene(scaled, Settings(radius=0.1 * scale, depth_margin=0.05 * scale))
    assert_agrees(renderer, scene, camera_looking(np.multiply((0.3, -1.2, 0.4), scale), (0, 0, 0)))


def test_renderer__does_not_jitter_far_from_the_origin(renderer):
    rng = np.random.default_rng(12)
    origin = np.array([4.5e5, 5.4e6, 100.0])
    splats = sheet(rng, 80)
    view = camera_looking(np.add((0.3, -1.2, 0.4), origin), origin)
    moved = Splats(splats.position + origin, splats.normal, splats.color)
    assert_agrees(renderer, build_scene(moved, Settings(origin=tuple(origin))), view)


def test_renderer__does_not_jitter_far_out_in_a_wide_scene(renderer):
    rng = np.random.default_rng(13)
    splats = sheet(rng, 120, half_width=0.05)
    middle = np.array([5000.3, 3000.7, 12.2])
    near_scene = Splats(splats.position * 0.2, splats.normal, splats.color)
    far_scene = Splats(near_scene.position + middle, splats.normal, splats.color)
    settings = Settings(radius=0.004, depth_margin=0.002)
    offset = np.array([0.0021, -0.0303, 0.0047])
    picture = drawn(renderer, build_scene(near_scene, settings), camera_looking(offset, (0, 0, 0)))
    view = camera_looking(offset, (0, 0, 0))
    view = type(view)(**{**view.__dict__, "centre": tuple(offset + middle)})
    far = build_scene(far_scene, settings)
    low = np.float64(far.arrays["box_low"])
    assert np.abs(low).max() > 1000
    expected, _ = render(far, view)
    assert psnr_db(drawn(renderer, far, view).rgb / 255, expected) >= 45
    assert picture.coverage.mean() > 0.3


def test_renderer__keeps_depth_apart_at_a_kilometre(renderer):
    near = np.array([[0.0, 0, 0]])
    up = np.array([[0.0, -1.0, 0]])
    color = np.array([[250, 10, 10], [10, 250, 10]], np.uint8)
    splats = Splats(np.concatenate([near, near + [0, 0.02, 0]]), np.repeat(up, 2, axis=0), color)
    scene = build_scene(splats, Settings(radius=0.1, depth_margin=0.005))
    view = camera_looking((0, -1000, 0), (0, 0, 0), (32, 32), (1e5, 1e5))
    picture = drawn(renderer, scene, view)
    off = np.hypot(*(np.indices((32, 32)) + 0.5 - np.array([view.cy_px, view.cx_px])[:, None, None]))
    assert picture.rgb[off < 8][:, 1].max() <= 11  # of 10 px: at its rim a splat hides nothing


def packed_rgb(rgb):
    return rgb.astype(np.int64) @ [1 << 16, 1 << 8, 1]


def test_renderer__shows_the_front_splat_alone_where_there_is_no_margin(renderer):
    rng = np.random.default_rng(16)
    splats = sheet(rng, 60)
    scene = build_scene(splats, Settings(depth_margin=0.0))
    picture = assert_agrees(renderer, scene, camera_looking((0.3, -1.2, 0.4), (0, 0, 0)), least_covered=0.3)
    alone = np.isin(packed_rgb(picture.rgb), packed_rgb(splats.color)) & picture.coverage
    assert alone.sum() / picture.coverage.sum() > 0.6  # at its rim the front splat hides nothing
    assert len(np.unique(packed_rgb(picture.rgb)[alone])) > 25


def test_renderer__stays_finite_in_thousands_of_layers(renderer):
    n = 3000
    splats = Splats(np.zeros((n, 3)), np.tile([0.0, -1.0, 0.0], (n, 1)), np.full((n, 3), 40, np.uint8))
    picture = drawn(renderer, build_scene(splats), camera_looking((0, -1, 0), (0, 0, 0)))
    assert picture.coverage.any()
    assert np.abs(picture.rgb[picture.coverage].astype(int) - 40).max() <= 30


def test_renderer__draws_the_same_picture_twice_and_at_other_sizes_between(renderer):
    rng = np.random.default_rng(14)
    gpu_scene = GpuScene(build_scene(sheet(rng, 60)), renderer.context)
    view, other = (camera_looking((0.3, -1.2, 0.4), (0, 0, 0), size) for size in ((64, 48), (31, 57)))
    first = renderer.render(gpu_scene, view)
    assert renderer.render(gpu_scene, other).rgb.shape == (57, 31, 3)
    again = renderer.render(gpu_scene, view)
    gpu_scene.release()
    assert (first.rgb == again.rgb).all() and list(first.pass_seconds) == ["cull", "visibility", "attribute", "resolve"]


def test_renderer__gives_a_black_uncovered_picture_where_nothing_is_seen(renderer):
    scene = build_scene(sheet(np.random.default_rng(15), 10))
    picture = drawn(renderer, scene, camera_looking((0, -2, 0), (0, -3, 0)))
    assert not picture.coverage.any() and not picture.rgb.any()
