"""Which open pixels a splat should cover: known planes of points, seen straight on and obliquely."""

import numpy as np
import pytest

from renderer.evaluate.unscanned import REACH, scanned_points, surrounded
from storage.packed.schema import Camera
from tests.renderer.evaluate.test_coverage import wall
from tests.scenes import Settings, build_scene

STEP = 0.1
EDGE = 2.0  # the plane is a square from -2 to 2


def plane(depth: float = 0.0) -> np.ndarray:
    steps = np.arange(-EDGE, EDGE + STEP / 2, STEP)
    x, y = np.meshgrid(steps, steps)
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, depth)])


def camera(tilt_degrees: float = 0.0) -> Camera:
    """Looks at the origin from 10 away; straight on a unit is 40 px, and (60, 60) its middle."""
    cos, sin = np.cos(np.radians(tilt_degrees)), np.sin(np.radians(tilt_degrees))
    rotation = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    return Camera(
        "v", 120, 120, 400.0, 400.0, 60.0, 60.0, tuple(map(tuple, rotation.tolist())), tuple(-10 * rotation[2])
    )


def found(position: np.ndarray, view: Camera | None = None) -> np.ndarray:
    view = view or camera()
    return surrounded(view, np.ones((120, 120), bool), position, np.full(len(position), STEP))


@pytest.mark.parametrize("tilt_degrees", [0, 40, 70])
def test_surrounded__is_a_plane_and_nothing_beyond_its_rim(tilt_degrees):
    inside = found(plane(), camera(tilt_degrees))
    half_px = EDGE * 40 * np.cos(np.radians(tilt_degrees))
    assert inside[59:61, 60 - int(0.7 * min(half_px, 59)) : 60].all()
    outside = np.abs(np.arange(120) + 0.5 - 60) > half_px * 1.3 + 1
    assert not inside[59:61, outside].any()


def test_surrounded__windows_are_where_they_are_wider_than_splats_grow():
    narrow, wide = (plane()[np.linalg.norm(plane(), axis=1) > side * STEP] for side in (1.4, REACH + 1.1))
    assert found(narrow)[60, 60] and not found(wide)[60, 60]
    assert found(wide)[60, 10]


def test_surrounded__between_two_surfaces_one_behind_the_other_nothing_is():
    near, far = plane()[plane()[:, 0] < -STEP / 4], plane(3.0)[plane()[:, 0] > 1.3 * 1.5 * STEP]
    both = found(np.concatenate([near, far]))
    assert not both[60, 61:64].any() and both[60, :50].all() and both[60, 80:100].all()
    assert found(np.concatenate([near, plane()[plane()[:, 0] > 1.3 * 1.5 * STEP]]))[60, 61:64].any()


def test_surrounded__only_wanted_pixels_and_none_without_points_near():
    wanted = np.zeros((120, 120), bool)
    wanted[60, 60] = True
    assert surrounded(camera(), wanted, plane(), np.full(len(plane()), STEP)).sum() == 1
    assert not surrounded(camera(), wanted, np.array([[0.0, 0, -30]]), np.array([STEP])).any()


def test_scanned_points__have_the_spacing_of_their_surroundings_whatever_the_radius():
    position, spacing = scanned_points(build_scene(wall(size=0.3), Settings(radius=0.05)))
    fine = position[:, 1] < np.median(position[:, 1])
    assert np.median(spacing[fine]) == pytest.approx(0.05, rel=0.1)
    assert np.median(np.sort(spacing)[-len(spacing) // 10 :]) == pytest.approx(0.15, rel=0.1)
