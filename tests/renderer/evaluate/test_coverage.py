"""Holes and coverage: figures of pictures and discs whose true values are known."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from pipeline.splats.decoded import scene_radii
from renderer.evaluate.coverage import draw_discs, surface_coverage
from renderer.evaluate.holes import HOLE, UNSCANNED, outline_holes, painted_holes
from renderer.pictures import on_background, save_animation
from storage.packed.scene import PackedScene
from storage.packed.schema import CHUNK
from tests.scenes import Settings, Splats, build_scene


def test_holes__are_gaps_that_nine_pixels_close_and_no_wider_ones():
    covered = np.zeros((60, 80), bool)
    covered[10:50, 10:70] = True
    assert outline_holes(covered) == 0
    covered[20:28, 20:28] = False  # 64 px
    assert outline_holes(covered) == 64 / 2400
    covered[30:45, 30:45] = False  # a window
    assert outline_holes(covered) == pytest.approx(64 / (2400 - 225))
    filled = covered.copy()
    filled[20:24, 20:28] = True  # half of the hole
    assert outline_holes(covered, filled) == pytest.approx(32 / (2400 - 225))
    painted = painted_holes(np.full((60, 80, 3), 7, np.uint8), covered, filled)
    assert tuple(painted[21, 21]) == HOLE and tuple(painted[26, 21]) == UNSCANNED
    assert (painted[covered] == 7).all() and (painted[35, 35] == 255).all()
    assert outline_holes(np.zeros((5, 5), bool)) == 0 and outline_holes(np.ones((5, 5), bool)) == 0


def wall(n=60, step=0.05, size=None):
    """A wall across x whose right half has three times the spacing."""
    x, z = np.meshgrid(np.arange(n) * step, np.arange(n) * step)
    fine = np.column_stack([np.zeros(n * n), x.ravel(), z.ravel()])
    coarse = 3 * fine[(x.ravel() < n * step / 3) & (z.ravel() < n * step / 3)] + [0, n * step, 0]
    position = np.concatenate([fine, coarse])
    size = np.where(np.arange(len(position)) < n * n, step, 3 * step) if size is None else np.full(len(position), size)
    return Splats(position - position.mean(axis=0), np.tile([1.0, 0, 0], (len(position), 1)), size=size)


def test_coverage__of_sizes_that_fit_is_whole_and_of_one_small_radius_is_not():
    rows = surface_coverage(build_scene(wall(), Settings(radius=0.05)), 1, (240, 180))
    assert len(rows) == 1 and rows[0].holes < 0.04 and rows[0].see_through == 0
    assert rows[0].overdraw == pytest.approx(1.0, abs=0.2)
    small = surface_coverage(build_scene(replace(wall(), size=None), Settings(radius=0.05)), 1, (240, 180))
    assert small[0].holes > 0.2 and small[0].overdraw < rows[0].overdraw


def test_coverage__larger_discs_overdraw_more():
    scene = build_scene(wall(size=0.3), Settings(radius=0.05))
    assert scene_radii(scene).min() > 0.2
    assert surface_coverage(scene, 1, (240, 180))[0].overdraw > 4


def test_coverage__of_levels_is_that_of_the_finest():
    fine, large = (build_scene(wall(size=size), Settings(radius=0.05)) for size in (None, 0.3))
    n = large.header.n_splats // CHUNK * CHUNK
    rows = {name: len(array) * n // large.header.n_splats for name, array in large.arrays.items()}
    arrays = {name: np.concatenate([large.arrays[name][: rows[name]], fine.arrays[name]]) for name in rows}
    header = replace(fine.header, n_splats=n + fine.header.n_splats, levels=(n, fine.header.n_splats))
    levelled, alone = (surface_coverage(s, 1, (240, 180))[0] for s in (PackedScene(header, arrays), fine))
    assert levelled.overdraw == pytest.approx(alone.overdraw, abs=0.1) and levelled.before == alone.before == 0


def test_discs__are_drawn_where_rays_meet_them():
    rng = np.random.default_rng(2)
    centre = np.column_stack([rng.uniform(-1, 1, (20, 2)), rng.uniform(3, 6, 20)])
    normal = rng.normal(size=(20, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    u = np.cross(normal, [0.3, 0.5, 0.8])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v, radius, lens = np.cross(normal, u), rng.uniform(0.2, 0.5, 20), np.array([60.0, 60.0, 40.0, 30.0])
    depth, owner = np.full((60, 80), np.inf), np.full((60, 80), -1)
    n_drawn = draw_discs(centre, u, v, radius, lens, depth, owner)
    column, row = np.meshgrid(np.arange(80) + 0.5, np.arange(60) + 0.5)
    ray = np.stack([(column - 40) / 60, (row - 30) / 60, np.ones_like(row)], axis=-1)
    expected, n_expected = np.full((60, 80), np.inf), 0
    for i in range(20):
        z = centre[i] @ normal[i] / (ray @ normal[i])
        inside = (np.linalg.norm(ray * z[..., None] - centre[i], axis=-1) < radius[i]) & (z > 0)
        expected[inside] = np.minimum(expected[inside], z[inside])
        n_expected += inside.sum()
    thin = np.isfinite(depth) != np.isfinite(expected)  # discs thinner than a pixel are drawn as if they were not
    assert thin.mean() < 0.02 and abs(n_drawn - n_expected) < 0.05 * n_expected
    both = np.isfinite(depth) & np.isfinite(expected)
    np.testing.assert_allclose(np.median(np.abs(depth[both] - expected[both])), 0, atol=1e-9)


def test_background__is_transparent_unless_it_is_chosen(tmp_path):
    rgb, covered = np.full((4, 6, 3), 90, np.uint8), np.zeros((4, 6), bool)
    covered[1:3] = True
    clear, white = on_background(rgb, covered), on_background(rgb, covered, (255, 255, 255))
    assert clear.shape == (4, 6, 4) and set(clear[..., 3].ravel()) == {0, 255} and (clear[1, 0, :3] == 90).all()
    assert white.shape == (4, 6, 3) and (white[0] == 255).all() and (white[1] == 90).all()
    save_animation(tmp_path / "a.webp", [clear, np.roll(clear, 1, axis=0), clear[::-1].copy()])
    with Image.open(tmp_path / "a.webp") as opened:
        assert opened.is_animated and opened.n_frames == 3 and opened.size == (6, 4)
