import numpy as np
import pytest

from pipeline.geometry.frame import tangent_frames
from pipeline.geometry.normals import decode_normals, encode_normals
from tests.reference_packed import every_normal

UP_AXES = pytest.mark.parametrize("up_axis", [0, 1, 2])


@UP_AXES
def test_frame__is_orthonormal_and_right_handed_for_every_code(up_axis):
    code, _ = every_normal()
    frame = np.stack(tangent_frames(code, up_axis), axis=1)  # (n, 3, 3)
    np.testing.assert_allclose(frame @ frame.transpose(0, 2, 1), np.broadcast_to(np.eye(3), frame.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(frame), 1, atol=1e-13)


@UP_AXES
def test_frame__normal_is_the_decoded_one(up_axis):
    code, _ = every_normal()
    assert (tangent_frames(code, up_axis)[2] == decode_normals(code)).all()


@UP_AXES
def test_frame__v_points_up_on_everything_but_floors(up_axis):
    code, normal = every_normal()
    u, v, _ = tangent_frames(code, up_axis)
    wall = np.abs(normal[:, up_axis]) < 0.9
    assert (v[wall, up_axis] > 0.43).all()  # sqrt(1 - 0.9^2)
    assert np.abs(u[wall, up_axis]).max() < 1e-15


@UP_AXES
def test_frame__v_follows_the_next_axis_on_floors(up_axis):
    code, normal = every_normal()
    u, v, _ = tangent_frames(code, up_axis)
    floor = np.abs(normal[:, up_axis]) > 0.9 + 1e-9
    assert floor.any()
    assert (v[floor, (up_axis + 1) % 3] > 0.89).all()
    assert np.abs(u[floor, (up_axis + 1) % 3]).max() < 1e-15


def test_frame__of_a_wall_and_a_floor():
    code = encode_normals(np.array([[1.0, 0, 0], [0, 0, 1.0]]))
    u, v, normal = tangent_frames(code, up_axis=2)
    assert u.tolist() == [[0, 1, 0], [0, -1, 0]]
    assert v.tolist() == [[0, 0, 1], [1, 0, 0]]
    assert normal.tolist() == [[1, 0, 0], [0, 0, 1]]
