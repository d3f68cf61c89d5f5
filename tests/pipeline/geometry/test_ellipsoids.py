"""Quantised ellipsoids come back within the bounds that their codec states."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.geometry.ellipsoids import (
    LONGEST_RADII,
    SHORTEST_RADII,
    decode_ellipsoids,
    encode_ellipsoids,
    lengths_of,
    squares_of,
)
from pipeline.geometry.normals import decode_normals, encode_normals

UP, AHEAD, RADIUS = (-5, -35, 6), (1, 5, 30), 0.02


def ellipsoids(n=4000, seed=0):
    """Random half axes, and the codes of their third's direction."""
    rng = np.random.default_rng(seed)
    lengths = RADIUS * np.exp(rng.uniform(np.log(SHORTEST_RADII), np.log(LONGEST_RADII), (n, 3)))
    axes = Rotation.random(n, rng).as_matrix() * lengths[..., None]
    return axes, encode_normals(axes[:, 2] / lengths[:, 2:])


def test_ellipsoids__lengths_come_back_within_the_stated_share():
    axes, normal = ellipsoids()
    found = decode_ellipsoids(encode_ellipsoids(normal, UP, AHEAD, axes, RADIUS), normal, UP, AHEAD, RADIUS)
    share = np.linalg.norm(found, axis=2) / np.linalg.norm(axes, axis=2)
    assert np.abs(share - 1).max() <= 0.011
    assert np.abs(share - 1).max() > 0.009  # the bound is no looser than the steps are


def test_ellipsoids__the_first_axis_turns_by_no_more_than_is_stated():
    axes, normal = ellipsoids()
    found = decode_ellipsoids(encode_ellipsoids(normal, UP, AHEAD, axes, RADIUS), normal, UP, AHEAD, RADIUS)[:, 0]
    n = decode_normals(normal)
    flat = axes[:, 0] - (axes[:, 0] * n).sum(axis=1, keepdims=True) * n
    cosine = np.abs((found * flat).sum(axis=1)) / np.linalg.norm(found, axis=1) / np.linalg.norm(flat, axis=1)
    angle = np.degrees(np.arccos(np.minimum(cosine, 1)))
    assert 0.3 < angle.max() <= 0.36


def test_ellipsoids__all_axes_stay_within_one_degree():
    """The normal's 0.64 degrees and half a step of the turn."""
    axes, normal = ellipsoids()
    found = decode_ellipsoids(encode_ellipsoids(normal, UP, AHEAD, axes, RADIUS), normal, UP, AHEAD, RADIUS)
    cosine = np.abs((found * axes).sum(axis=2)) / np.linalg.norm(found, axis=2) / np.linalg.norm(axes, axis=2)
    assert np.degrees(np.arccos(np.minimum(cosine, 1))).max() < 1.0


def test_ellipsoids__decoded_axes_are_at_right_angles_and_right_handed():
    axes, normal = ellipsoids(500)
    found = decode_ellipsoids(encode_ellipsoids(normal, UP, AHEAD, axes, RADIUS), normal, UP, AHEAD, RADIUS)
    unit = found / np.linalg.norm(found, axis=2, keepdims=True)
    np.testing.assert_allclose(unit @ unit.transpose(0, 2, 1), np.tile(np.eye(3), (500, 1, 1)), atol=1e-12)
    assert (np.linalg.det(unit) > 0).all()
    np.testing.assert_allclose(unit[:, 2], decode_normals(normal), atol=1e-12)


@pytest.mark.parametrize("length, expected", [(0.0, SHORTEST_RADII), (1e9, LONGEST_RADII), (1e-30, SHORTEST_RADII)])
def test_ellipsoids__lengths_out_of_range_become_the_nearer_bound(length, expected):
    axes = np.eye(3)[None] * RADIUS
    axes[0, 1] *= length
    normal = encode_normals(np.array([[0.0, 0.0, 1.0]]))
    fields = encode_ellipsoids(normal, UP, AHEAD, axes, RADIUS)
    np.testing.assert_allclose(lengths_of(fields, RADIUS)[0], RADIUS * np.array([1, expected, 1]))


def test_ellipsoids__one_radius_is_exact_and_coding_twice_changes_nothing():
    axes, normal = ellipsoids(500, seed=1)
    fields = encode_ellipsoids(normal, UP, AHEAD, axes, RADIUS)
    again = encode_ellipsoids(normal, UP, AHEAD, decode_ellipsoids(fields, normal, UP, AHEAD, RADIUS), RADIUS)
    assert (again == fields).all()
    disc = np.eye(3)[None] * RADIUS
    assert (lengths_of(encode_ellipsoids(normal[:1], UP, AHEAD, disc, RADIUS), RADIUS) == RADIUS).all()


def test_ellipsoids__every_word_decodes_to_a_finite_ellipsoid():
    rng = np.random.default_rng(2)
    fields = rng.integers(0, 256, (1000, 4)).astype(np.uint8)
    fields[0], fields[1] = 0, 255
    normal = rng.integers(-127, 128, (1000, 2)).astype(np.int8)
    found = decode_ellipsoids(fields, normal, UP, AHEAD, RADIUS)
    assert np.isfinite(found).all()
    assert np.abs(np.linalg.norm(found, axis=2) / RADIUS).max() <= LONGEST_RADII * (1 + 1e-12)


def test_ellipsoids__none_have_no_fields():
    none = np.zeros((0, 2), np.int8)
    assert encode_ellipsoids(none, UP, AHEAD, np.zeros((0, 3, 3)), RADIUS).shape == (0, 4)
    assert decode_ellipsoids(np.zeros((0, 4), np.uint8), none, UP, AHEAD, RADIUS).shape == (0, 3, 3)


def test_squares__lie_as_high_as_the_surface_on_average_and_others_stay():
    across = np.linspace(-1, 1, 2001)
    x, y = np.meshgrid(across, across)
    inside = x**2 + y**2 < 1
    mean_height = np.sqrt(1 - x[inside] ** 2 - y[inside] ** 2).mean()  # of half a ball over its disc
    centre, u, v = np.arange(9.0).reshape(3, 3), np.tile([1.0, 0, 0], (3, 1)), np.tile([0, 1.0, 0], (3, 1))
    axes = np.array([[[0, 0.5, 0], [0, 0, 0.25], [0.125, 0, 0]]])
    moved, along, over = squares_of(centre, u, v, np.array([1]), axes, radius=0.5)
    np.testing.assert_allclose(moved[1] - centre[1], [0.125 * mean_height, 0, 0], atol=1e-4)
    np.testing.assert_array_equal([along[1], over[1]], [[0, 1, 0], [0, 0, 0.5]])
    for before, after in ((centre, moved), (u, along), (v, over)):
        np.testing.assert_array_equal(before[[0, 2]], after[[0, 2]])
