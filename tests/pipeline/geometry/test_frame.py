from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.geometry.frame import directions_of, tangent_frames, whole_direction
from pipeline.geometry.normals import decode_normals, encode_normals
from storage.packed.schema import LONGEST_DIRECTION
from tests.reference_packed import every_normal

AXES = np.eye(3, dtype=int).tolist()
DIRECTIONS = pytest.mark.parametrize(
    ("up", "ahead"),
    [
        (AXES[0], AXES[1]),
        (AXES[1], AXES[2]),
        (AXES[2], AXES[0]),
        ((3, -35, 7), (30, 5, 12)),
        ((-20, 20, -22), (20, 20, 1)),
    ],
)


def unit(vector):
    return np.array(vector) / np.linalg.norm(vector)


@DIRECTIONS
def test_frame__is_orthonormal_and_right_handed_for_every_code(up, ahead):
    code, _ = every_normal()
    frame = np.stack(tangent_frames(code, up, ahead), axis=1)  # (n, 3, 3)
    np.testing.assert_allclose(frame @ frame.transpose(0, 2, 1), np.broadcast_to(np.eye(3), frame.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(frame), 1, atol=1e-13)


@DIRECTIONS
def test_frame__normal_is_the_decoded_one(up, ahead):
    code, _ = every_normal()
    assert (tangent_frames(code, up, ahead)[2] == decode_normals(code)).all()


@DIRECTIONS
def test_frame__v_points_up_on_everything_but_floors(up, ahead):
    code, normal = every_normal()
    u, v, _ = tangent_frames(code, up, ahead)
    wall = np.abs(normal @ unit(up)) < 0.9
    assert (v[wall] @ unit(up) > 0.43).all()  # sqrt(1 - 0.9^2)
    assert np.abs(u[wall] @ unit(up)).max() < 1e-15


@DIRECTIONS
def test_frame__v_points_ahead_on_floors(up, ahead):
    code, normal = every_normal()
    u, v, _ = tangent_frames(code, up, ahead)
    floor = np.abs(normal @ unit(up)) > 0.9 + 1e-9
    assert floor.any()
    assert (v[floor] @ unit(ahead) > 0.5).all()
    assert np.abs(u[floor] @ unit(ahead)).max() < 1e-15


def test_frame__of_a_wall_and_a_floor():
    code = encode_normals(np.array([[1.0, 0, 0], [0, 0, 1.0]]))
    u, v, normal = tangent_frames(code, (0, 0, 1), (1, 0, 0))
    assert u.tolist() == [[0, 1, 0], [0, -1, 0]]
    assert v.tolist() == [[0, 0, 1], [1, 0, 0]]
    assert normal.tolist() == [[1, 0, 0], [0, 0, 1]]


def test_frame__the_decision_fits_into_32_bits():
    """What the shader computes, with the longest direction and every normal."""
    point = np.array(
        [(a, b, 127 - abs(a) - abs(b)) for a in range(-127, 128) for b in range(-127 + abs(a), 128 - abs(a))]
    )
    longest = np.array([(36, 0, 0), (20, 20, 22), (-35, 8, 2)])
    assert (np.linalg.norm(longest, axis=1) <= LONGEST_DIRECTION).all()
    assert (100 * (point @ longest.T) ** 2).max() < 2**31
    assert 81 * (point**2).sum(axis=1).max() * LONGEST_DIRECTION**2 < 2**31


# --- directions of a scan
# ------------------------------------------------------------------------------------------------


def looking(rng, n, roll_degrees=0.0):
    """Cameras (n, 3, 3) that look more or less along x, z up, turned about their own axis."""
    upright = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    yaw = Rotation.from_euler("zy", rng.uniform(-30, 30, (n, 2)) * [1, 0.4], degrees=True).as_matrix()
    roll = Rotation.from_euler("z", roll_degrees, degrees=True).as_matrix()
    return [SimpleNamespace(rotation=roll @ upright @ turn.T) for turn in yaw]


def test_directions__of_upright_photographs_are_up_and_ahead():
    up, ahead = directions_of(looking(np.random.default_rng(0), 12))
    assert unit(up)[2] > 0.98 and unit(ahead)[0] > 0.9


def test_directions__follow_the_photographs_columns_where_they_lie_on_their_side():
    up, _ = directions_of(looking(np.random.default_rng(0), 12, roll_degrees=90))
    assert abs(unit(up)[1]) > 0.9


def test_directions__turn_with_the_scan():
    rng = np.random.default_rng(1)
    cameras = looking(rng, 9)
    still = [unit(d) for d in directions_of(cameras)]
    for turn in Rotation.random(50, random_state=rng).as_matrix():
        turned = directions_of([SimpleNamespace(rotation=c.rotation @ turn.T) for c in cameras])
        assert all(np.linalg.norm(d) <= LONGEST_DIRECTION for d in turned)
        for a, b in zip(still, turned, strict=True):
            assert np.degrees(np.arccos(min(1.0, turn @ a @ unit(b)))) < 3.6  # 1.2 each, and ahead also leans with up


@pytest.mark.parametrize(
    "rotations",
    [
        [np.diag([1.0, -1, -1])],
        [np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1])],  # straight down, to and fro
        [np.eye(3)] * 3,
        Rotation.from_euler("y", [[0], [90], [180], [270]], degrees=True).as_matrix(),  # all around
    ],
    ids=["down", "to and fro", "one direction", "all around"],
)
def test_directions__exist_for_every_arrangement_and_are_apart(rotations):
    up, ahead = directions_of([SimpleNamespace(rotation=r) for r in rotations])
    assert abs(unit(up) @ unit(ahead)) < 0.5


def test_directions__of_a_scan_without_photographs_are_z_and_x():
    assert directions_of([]) == ((0, 0, 1), (1, 0, 0))


def test_directions__whole_numbers_are_within_a_degree():
    rng = np.random.default_rng(2)
    for direction in rng.standard_normal((500, 3)):
        found = whole_direction(direction)
        assert np.linalg.norm(found) <= LONGEST_DIRECTION
        assert np.degrees(np.arccos(min(1.0, unit(found) @ unit(direction)))) < 1.2
    assert whole_direction(np.array([0.0, -1e-9, 0.0])) == (0, -1, 0)
    for longest in ((35, 8, 2), (-20, 22, 20), (36, 0, 0)):
        assert whole_direction(np.array(longest) / 7.0) == tuple(n // np.gcd.reduce(longest) for n in longest)


def test_directions__ahead_is_level_where_photographs_look_down_and_up_alike():
    """At right angles to up, not to what happens to be the cameras' mean."""
    upright = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    for tilt in (-50, 20, 60):
        turn = Rotation.from_euler("y", tilt, degrees=True).as_matrix()
        up, ahead = directions_of([SimpleNamespace(rotation=upright @ turn.T), SimpleNamespace(rotation=upright)])
        assert abs(unit(up) @ unit(ahead)) < np.sin(np.radians(2.4))  # 1.2 degrees each
