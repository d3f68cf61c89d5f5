"""Corners of splat squares against points carried through the camera one by one."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.texture.projection import corner_depths, homographies, is_whole, project_corners
from storage.packed.schema import Camera

ORIGIN = (100.0, -50.0, 7.0)
SIGNS = [(-1, -1), (-1, 1), (1, -1), (1, 1)]


def camera_at(turn: np.ndarray) -> Camera:
    return Camera("c", 640, 480, 500.0, 450.0, 330.0, 220.0, tuple(map(tuple, turn.tolist())), (101.0, -49.0, 3.0))


def some_squares(rng, n: int, camera: Camera, radius: float):
    """n squares of any slant about 5 before the camera."""
    turn = np.array(camera.rotation)
    centre = (np.array(camera.centre) - ORIGIN) + (
        np.column_stack([rng.uniform(-1, 1, (n, 2)), rng.uniform(4, 6, n)])
    ) @ turn
    frame = Rotation.random(n, random_state=rng).as_matrix()
    return centre, frame[:, 0], frame[:, 1], homographies(camera, ORIGIN, centre, frame[:, 0], frame[:, 1], radius)


def test_projection__corners_and_their_depths_are_those_of_points_in_space():
    rng = np.random.default_rng(0)
    camera = camera_at(Rotation.random(random_state=rng).as_matrix())
    radius = 0.3
    centre, u, v, h = some_squares(rng, 50, camera, radius)
    for corner, (a, b) in enumerate(SIGNS):
        point = centre + radius * (a * u + b * v) + ORIGIN - np.array(camera.centre)
        x, y, z = np.array(camera.rotation) @ point.T
        np.testing.assert_allclose(corner_depths(h)[:, corner], z, rtol=1e-12)
        pixel = np.column_stack([500 * x / z + 330, 450 * y / z + 220])
        np.testing.assert_allclose(project_corners(h)[:, corner], pixel, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("x_px", "y_px", "whole"),
    [
        (11, 240, True),
        (9, 240, False),
        (629, 240, True),
        (631, 240, False),
        (320, 10, True),
        (320, 8, False),
        (320, 470, True),
        (320, 472, False),
    ],
)
def test_projection__a_square_is_whole_to_the_photo_s_edge_and_no_further(x_px, y_px, whole):
    """20 px wide and 18 px high."""
    camera = camera_at(np.eye(3))
    depth = 5.0
    at = np.array([(x_px - 330) / 500, (y_px - 220) / 450, 1.0]) * depth
    centre = (at + camera.centre - ORIGIN)[None]
    h = homographies(camera, ORIGIN, centre, np.array([[1.0, 0, 0]]), np.array([[0, 1.0, 0]]), 10 * depth / 500)
    assert is_whole(h, 640, 480)[0] == whole
