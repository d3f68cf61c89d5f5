"""Geometry far from zero, and neighbourhoods that define nothing. Bounds as in docs/NUMERICS.md."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.chunks import median_split
from pipeline.geometry.normals import decode_normals, encode_normals
from pipeline.geometry.positions import decode_positions, encode_positions, fit_boxes
from pipeline.numerics.limits import LARGEST_COORDINATE
from pipeline.splats.neighbours import Blocks, find_neighbours
from pipeline.splats.normals import NEIGHBOURS, estimate_normals, turned_to, usable_normals
from storage.packed.schema import CHUNK, GROUP
from tests import reference

FAR = np.array([4.5e5, 5.4e6, 100.0])


def rough_plane(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    flat = np.column_stack([rng.uniform(-1, 1, (n, 2)), rng.normal(0, 1e-3, n)])
    tilt = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    return flat @ tilt.T


def neighbours_of(points: np.ndarray, k: int = NEIGHBOURS):
    return find_neighbours(0, k, Blocks(lambda _: points, points.min(axis=0)[None], points.max(axis=0)[None]))


def degrees_apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Between directions without sign."""
    return np.degrees(np.arcsin(np.minimum(1, np.linalg.norm(np.cross(a, b), axis=1))))


# --- far from zero
# -----------------------------------------------------------------------------------------------------


def test_geometry__positions_far_from_zero_are_as_exact_as_near():
    near = rough_plane(2000)[median_split(rough_plane(2000))]
    far = (near + FAR) - (near + FAR).mean(axis=0)
    for position in (near, far):
        boxes = fit_boxes(position)
        error = np.abs(decode_positions(encode_positions(position, boxes), boxes) - position)
        chunk = np.arange(len(position)) // CHUNK
        cell = boxes.size[chunk].astype(float) / 2.0 ** boxes.bits[chunk]
        assert (error <= cell / 2 * (1 + 1e-9) + 1e-12).all()
        assert error.max() < 2e-3
    assert np.abs(reference.float32_positions(near + FAR) - (near + FAR)).max() > 0.1  # the naive way: absolute float32


def test_geometry__normals_far_from_zero_are_as_exact_as_near():
    near = rough_plane(800)
    expected, _ = estimate_normals(near, neighbours_of(near).position)
    far = near + FAR
    found, flagged = estimate_normals(far, neighbours_of(far).position)
    assert not flagged.any()
    assert np.median(degrees_apart(found, expected)) < 1e-4 and degrees_apart(found, expected).max() < 0.1
    naive = reference.normals_from_raw_moments(neighbours_of(far).position.astype(np.float32))
    assert np.median(degrees_apart(naive, expected)) > 10  # the naive way: raw second moments in float32


# --- neighbourhoods that define no plane
# -------------------------------------------------------------------------------


def degenerate(name: str) -> np.ndarray:
    rng = np.random.default_rng(1)
    t = rng.uniform(-1, 1, 40)
    line = np.outer(t, [0.3, -0.5, 0.8])
    return {
        "identical": np.tile([1.0, 2, 3], (40, 1)),
        "collinear": line,
        "collinear, along x": np.outer(t, [1, 0, 0]),
        "two points": np.array([[0.0, 0, 0], [1, 1, 0]]),
        "one point": np.zeros((1, 3)),
        "collinear, almost": line + 1e-9 * rng.standard_normal((40, 3)),
        "collinear, far": line + FAR,
        "collinear, tiny": line * 1e-150,
        "collinear, huge": line * 1e14,
    }[name]


@pytest.mark.parametrize(
    "name",
    [
        "identical",
        "collinear",
        "collinear, along x",
        "two points",
        "one point",
        "collinear, almost",
        "collinear, far",
        "collinear, tiny",
        "collinear, huge",
    ],
)
def test_geometry__a_neighbourhood_without_a_plane_is_flagged_and_has_a_unit_normal(name):
    points = degenerate(name)
    found = neighbours_of(points)
    normal, flagged = estimate_normals(points, found.position)
    assert flagged.all()
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-12)
    again, _ = estimate_normals(points.copy(), found.position.copy())
    assert (normal == again).all()
    if name in ("identical", "collinear, along x"):
        assert np.isnan(reference.normals_from_two_edges(np.tile(points[:3], (2, 1, 1)))).all()  # the naive way
    if "collinear" in name and name != "collinear, far":
        along = points[np.abs(points).sum(axis=1).argmax()] - points.mean(axis=0)
        assert np.abs(normal @ (along / np.linalg.norm(along))).max() < 1e-6


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e12])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_geometry__an_exact_plane_has_its_normal_and_no_flag(axis, scale):
    rng = np.random.default_rng(2)
    points = np.insert(rng.uniform(-1, 1, (200, 2)), axis, 0.25, axis=1) * scale
    normal, flagged = estimate_normals(points, neighbours_of(points).position)
    assert not flagged.any()
    assert degrees_apart(normal, np.tile(np.eye(3)[axis], (200, 1))).max() < 1e-5


def test_geometry__isolated_points_and_pairs_among_many_have_unit_normals():
    points = np.concatenate([rough_plane(300), [[1e6, 0, 0]], [[0, 1e9, 0]], [[0, 1e9, 1e-3]]])
    normal, flagged = estimate_normals(points, neighbours_of(points).position)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-12)
    assert not flagged[:300].any() and flagged[-2:].all()


def test_geometry__given_normals_that_are_none_are_flagged():
    given = np.array(
        [[0, 0, 0], [np.nan, 0, 1], [0, np.inf, 0], [0, 0, 5], [1e-30, 0, 0], [1e-45, 0, 0], [3e38, 3e38, 0]],
        np.float32,
    )
    normal, flagged = usable_normals(given)
    assert flagged.tolist() == [True, True, True, False, False, False, False]
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-12)
    assert (normal[:3] == [0, 0, 1]).all()


def test_geometry__normals_turn_to_the_viewer_and_stay_where_they_lie_edge_on():
    normal = np.array([[0, 0, 1.0], [0, 0, 1], [0, 0, 1]])
    towards = np.array([[0, 0, -2.0], [0, 0, 2], [1, 0, 0]])
    assert (turned_to(normal, towards)[:, 2] == [-1, 1, 1]).all()


# --- octahedral codes -------------------------------------------------------------------------------------------------


def hard_normals() -> np.ndarray:
    rng = np.random.default_rng(3)
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    poles = np.repeat(axes, 3000, axis=0) + rng.standard_normal((18_000, 3)) * 10 ** rng.uniform(-16, -1, (18_000, 1))
    edges = rng.standard_normal((6000, 3)) * np.array([[0, 1, 1], [1, 0, 1], [1, 1, 0]])[rng.integers(0, 3, 6000)]
    return np.concatenate([axes, poles, edges, rng.standard_normal((100_000, 3))])


def test_geometry__octahedral_normals_are_within_064_degrees_and_032_on_average():
    normal = hard_normals()
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    off = degrees_apart(decode_normals(encode_normals(normal)), normal)
    assert off.max() <= 0.64 and off[-100_000:].mean() <= 0.32
    assert (decode_normals(encode_normals(normal[:6])) == normal[:6]).all()
    naive = degrees_apart(decode_normals(reference.rounded_octahedral(normal)), normal)
    assert naive.max() > 0.9  # the naive way: plain rounding


def test_geometry__decoded_normals_keep_their_hemisphere():
    normal = hard_normals()
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    assert ((decode_normals(encode_normals(normal)) * normal).sum(axis=1) > 0.9999).all()


# --- median split and boxes -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [0, 1, 2, CHUNK - 1, CHUNK, CHUNK + 1, 3 * CHUNK + 5, GROUP + 77])
@pytest.mark.parametrize("kind", ["all equal", "ties", "a line", "a plane", "a far outlier"])
def test_geometry__median_split_is_a_permutation_into_whole_chunks(n, kind):
    rng = np.random.default_rng(4)
    points = rng.uniform(-1, 1, (n, 3))
    if kind == "all equal":
        points[:] = 7
    elif kind == "ties":
        points = np.round(points * 2)
    elif kind == "a line":
        points[:, 1:] = 0
    elif kind == "a plane":
        points[:, 2] = 0
    elif n:
        points[0] = LARGEST_COORDINATE
    order = median_split(points)
    assert (np.sort(order) == np.arange(n)).all() and (order == median_split(points.copy())).all()
    boxes = fit_boxes(points[order])
    error = np.abs(decode_positions(encode_positions(points[order], boxes), boxes) - points[order])
    chunk = np.arange(n) // CHUNK
    half = boxes.size[chunk].astype(float) / 2.0 ** (boxes.bits[chunk].astype(int) + 1)
    assert np.isfinite(error).all() and (error <= half * (1 + 1e-9) + 1e-12 * np.abs(points[order])).all()
    if kind == "all equal":
        assert (order == np.arange(n)).all()
        if n > CHUNK:
            with pytest.raises(RecursionError):  # the naive way: nothing lies below the median
                reference.split_at_the_median_value(points, CHUNK)


def test_geometry__a_zero_extent_gives_its_bits_to_the_others():
    points = np.column_stack([np.linspace(0, 1, CHUNK), np.zeros(CHUNK), np.linspace(0, 1, CHUNK)])
    boxes = fit_boxes(points)
    assert boxes.bits.tolist() == [[12, 0, 12]]
    assert not decode_positions(encode_positions(points, boxes), boxes)[:, 1].any()
    assert np.isnan(reference.cells_of_an_extent(points, 8)[:, 1]).all()  # the naive way: 0 / 0


def test_geometry__a_million_duplicates_are_split_and_have_neighbours():
    points = np.tile([[1.0, 2, 3], [1, 2, 3.5]], (500_000, 1))
    order = median_split(points)
    fit_boxes(points[order])
    found = neighbours_of(points[:16_384], 4)
    assert (found.distance[:, 0] == 0.5).all() and np.isinf(found.distance[:, 1:]).all()


def test_geometry__the_scan_s_own_largest_coordinates_fit_their_boxes():
    points = np.random.default_rng(5).uniform(-1, 1, (300, 3)) * LARGEST_COORDINATE
    boxes = fit_boxes(points)
    assert np.isfinite(boxes.size).all() and np.isfinite(decode_positions(encode_positions(points, boxes), boxes)).all()
