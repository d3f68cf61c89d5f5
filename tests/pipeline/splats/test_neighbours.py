"""Neighbours over blocks are those of the whole; normals and cameras are what they should be."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pipeline.geometry.chunks import median_split
from pipeline.splats.cameras import N_CANDIDATES, best_cameras, rank_candidates, sharpness
from pipeline.splats.neighbours import Blocks, find_neighbours
from pipeline.splats.normals import estimate_normals, turned_to, usable_normals
from pipeline.splats.visibility import draw_points, empty_map, map_scale, seen_points
from storage.packed.schema import NO_CAMERA, Camera


def in_blocks(points: np.ndarray, size: int) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    blocks = [points[i : i + size] for i in range(0, len(points), size)]
    return blocks, np.array([b.min(axis=0) for b in blocks]), np.array([b.max(axis=0) for b in blocks])


@pytest.mark.parametrize("kind", ["cloud", "sheet", "far outliers"])
def test_neighbours__over_blocks_are_those_of_one_tree(kind):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(3000, 3)) * ([1, 1, 1e-3] if kind == "sheet" else 1)
    if kind == "far outliers":
        points[::500] *= 1000
    points = points[median_split(points)]
    blocks, low, high = in_blocks(points, 384)
    distance = cKDTree(points).query(points, k=6)[0][:, 1:]
    found = [find_neighbours(b, 5, Blocks(blocks.__getitem__, low, high)) for b in range(len(blocks))]
    np.testing.assert_allclose(np.concatenate([f.distance for f in found]), distance, rtol=1e-12)
    position = np.concatenate([f.position for f in found])
    np.testing.assert_allclose(np.linalg.norm(position - points[:, None], axis=2), distance, rtol=1e-9)


def test_neighbours__a_twin_is_no_neighbour_and_missing_ones_are_at_infinity():
    points = np.array([[0.0, 0, 0]] * 5 + [[1.0, 0, 0]] * 3 + [[0, 2.0, 0]])
    found = find_neighbours(0, 4, Blocks(lambda b: points, points[None].min(axis=1), points[None].max(axis=1)))
    np.testing.assert_allclose(found.distance[0], [1, 2, np.inf, np.inf])
    np.testing.assert_allclose(found.distance[8], [2, np.sqrt(5), np.inf, np.inf])
    assert (found.position[0, 2:] == points[0]).all()


def test_neighbours__many_duplicates_take_no_longer_than_few():
    points = np.zeros((16384, 3))
    points[::4] = np.random.default_rng(0).normal(size=(4096, 3))
    found = find_neighbours(0, 4, Blocks(lambda b: points, points[None].min(axis=1), points[None].max(axis=1)))
    assert np.isfinite(found.distance).all()


@pytest.mark.parametrize("offset", [0.0, 5.4e6])
def test_normals__of_a_plane_are_its_own_wherever_it_lies(offset):
    rng = np.random.default_rng(1)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points = rng.uniform(-1, 1, (400, 2)) @ axes[:2] + offset
    _, index = cKDTree(points).query(points, k=17)
    normal, degenerate = estimate_normals(points, points[index[:, 1:]])
    assert not degenerate.any()
    assert np.abs(normal @ axes[2]).min() > (1 - 1e-12 if offset == 0 else 1 - 1e-9)


def test_normals__where_none_is_defined_one_is_made_and_flagged():
    line = np.outer(np.arange(17.0), [1, 2, 3])
    point = np.zeros((1, 17, 3))
    normal, degenerate = estimate_normals(np.array([line[0], [0.0, 0, 0]]), np.stack([line[1:], point[0, 1:]]))
    assert degenerate.all() and np.isfinite(normal).all()
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1)
    assert normal[0] @ [1, 2, 3] == pytest.approx(0, abs=1e-12) and normal[1].tolist() == [0, 0, 1]


def test_normals__given_ones_are_made_unit_and_bad_ones_flagged():
    normal, bad = usable_normals(np.array([[0, 3, 0], [0, 0, 0], [np.nan, 0, 1], [1e-20, 0, 0]], np.float32))
    assert bad.tolist() == [False, True, True, False]
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1)
    assert (turned_to(normal, np.array([[0.0, -1, 0]] * 4))[0] == [0, -1, 0]).all()


LOOKS_DOWN_Z = ((1, 0, 0), (0, 1, 0), (0, 0, 1))


def camera_at(x: float, z: float, f: float = 100.0) -> Camera:
    return Camera(f"at {x} {z}", 200, 200, f, f, 100.0, 100.0, LOOKS_DOWN_Z, (x, 0.0, z))


def test_cameras__the_one_with_most_pixels_for_the_splat_wins():
    cameras = (camera_at(0, -5), camera_at(0, -3), camera_at(0, -4, f=300.0))
    position, normal = np.zeros((1, 3)), np.array([[0.0, 0, -1]])
    seen = np.ones((1, 4), bool)
    assert best_cameras(cameras, position, normal, 0.01, seen)[0] == 2
    seen[0, 2] = False
    assert best_cameras(cameras, position, normal, 0.01, seen)[0] == 1
    assert best_cameras(cameras, position, normal, 0.01, np.zeros((1, 4), bool))[0] == NO_CAMERA


def test_cameras__a_grazing_one_an_edge_and_the_back_do_not_count():
    position = np.zeros((3, 3))
    normal = np.array([[1.0, 0, -0.05], [0, 0, -1], [0, 0, -1]])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    position[1] = [12.0, 0, 0]  # beside the photo
    position[2] = [0, 0, -20.0]  # behind the camera
    assert (best_cameras((camera_at(0, -5),), position, normal, 0.01, np.ones((3, 2), bool)) == NO_CAMERA).all()


def test_cameras__one_that_holds_the_whole_splat_goes_before_a_sharper_one_that_does_not():
    cameras = (camera_at(0, -5), camera_at(2.95, -3))  # the second has the origin 1.7 px from its edge
    position, normal, seen = np.zeros((1, 3)), np.array([[0.0, 0, -1]]), np.ones((1, 3), bool)
    assert best_cameras(cameras, position, normal, 0.2, seen)[0] == 0
    assert best_cameras(cameras, position, normal, 0.001, seen)[0] == 1
    assert best_cameras(cameras, position, normal, 0.2, np.array([[False, True, False]]))[0] == 1


def test_cameras__candidates_are_ranked_by_sharpness():
    cameras = tuple(camera_at(0, -3.0 - i) for i in range(10))
    count = np.array([10, 0, 2])
    ranked = rank_candidates(np.zeros((3, 3)), None, count, np.array([*range(9, -1, -1), 7, 4]), cameras)
    assert ranked.shape == (3, N_CANDIDATES)
    assert ranked[0].tolist() == list(range(8))
    assert (ranked[1] == NO_CAMERA).all() and ranked[2, :3].tolist() == [4, 7, NO_CAMERA]


@pytest.mark.parametrize("with_normals", [False, True])
def test_cameras__candidates_are_those_of_a_stable_sort_by_sharpness(with_normals):
    """Ties stay in the order of the list, cameras seen from behind come last, more than N_CANDIDATES are cut off."""
    rng = np.random.default_rng(4)
    cameras = tuple(camera_at(x, z) for x in (-1.0, 0.0, 1.0) for z in (-5.0, -3.0, -3.0, 4.0))
    position, normal = rng.uniform(-1, 1, (200, 3)), rng.standard_normal((200, 3)) if with_normals else None
    count = rng.integers(0, len(cameras) + 1, 200)
    lists = [rng.permutation(len(cameras))[:n] for n in count]
    ranked = rank_candidates(position, normal, count, np.concatenate(lists), cameras)
    for i, seen_by in enumerate(lists):
        score = [
            sharpness(cameras[c], position[i : i + 1], None if normal is None else normal[i : i + 1])[0]
            for c in seen_by
        ]
        expected = [seen_by[j] for j in sorted(range(len(seen_by)), key=lambda j: -score[j])][:N_CANDIDATES]
        assert ranked[i].tolist() == expected + [NO_CAMERA] * (N_CANDIDATES - len(expected))


def test_visibility__a_wall_hides_what_is_behind_it_and_not_what_is_on_it():
    rng = np.random.default_rng(2)
    front = np.column_stack([rng.uniform(-1, 1, (20000, 2)), np.zeros(20000)])
    behind = front[:5000] * 0.5 + [0, 0, 1.0]
    camera, radius = camera_at(0, -5), 0.02
    depth_map = empty_map(camera, map_scale(camera, 5.0, radius))
    for part in (behind, front):
        draw_points(depth_map, camera, part, radius)

    def seen(points):
        return seen_points(depth_map, camera, points, np.tile([0.0, 0, -1], (len(points), 1)), radius)

    assert seen(front).mean() > 0.999 and seen(behind).mean() < 0.01
    assert not seen(np.array([[0, 0, -9.0], [50.0, 0, 0]])).any()


@pytest.mark.parametrize("degrees", [60, 80])
def test_visibility__a_slanted_wall_does_not_hide_itself(degrees):
    rng = np.random.default_rng(3)
    slope = np.radians(degrees)
    flat = rng.uniform(-1, 1, (20000, 2))
    wall = np.column_stack([flat[:, 0] * np.cos(slope), flat[:, 1], flat[:, 0] * np.sin(slope)])
    normal = np.tile([-np.sin(slope), 0, np.cos(slope)], (20000, 1))
    camera, radius = camera_at(0, -5), 0.02
    depth_map = empty_map(camera, map_scale(camera, 5.0, radius))
    draw_points(depth_map, camera, wall, radius)
    assert seen_points(depth_map, camera, wall, normal, radius).mean() > 0.99
