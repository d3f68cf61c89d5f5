"""Both projections are what `pipeline.cameras.camera` promises, at the poles, along the seam and far from zero."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.cameras.pinhole import Pinhole
from pipeline.cameras.polar_capped import PolarCapped, height_for
from storage.packed.schema import Camera

ANGLE = st.floats(-180, 180).map(np.radians)
MOST_DEGREES = 1e-5


def a_pinhole() -> Pinhole:
    turn = np.linalg.qr(np.array([[2.0, 1, 0], [0, 1, 1], [1, 0, 3]]))[0]
    turn *= np.sign(np.linalg.det(turn))
    return Pinhole(
        Camera("p", 640, 480, 500.0, 520.0, 300.0, 250.0, tuple(map(tuple, turn.tolist())), (4.5e5, 5e6, 9.0))
    )


def directions(theta: np.ndarray, psi: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(psi) * np.cos(theta), np.cos(psi) * np.sin(theta), np.sin(psi)], axis=-1)


def degrees_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """By the sine and the cosine: the cosine alone cannot tell angles below 1e-6 degrees."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(axis=-1)))


def hard_directions() -> np.ndarray:
    """Poles and what lies about them by 1e-12 to 1e-3, the seam from both sides, the edges of caps and band."""
    tiny = 10.0 ** np.arange(-12, -2)
    around = np.radians([-180, -179.9999999, -90, -1e-9, 0, 1e-9, 45, 90, 180])
    near = [np.pi / 2 - tiny, tiny - np.pi / 2, np.pi / 4 + tiny, np.pi / 4 - tiny, tiny - np.pi / 4, -np.pi / 4 - tiny]
    psi = np.concatenate([[np.pi / 2, -np.pi / 2, np.pi / 4, -np.pi / 4, 0], *near])
    theta, psi = (a.ravel() for a in np.meshgrid(around, psi))
    seam = directions(np.concatenate([tiny, -tiny, np.pi - tiny]), np.zeros(30))
    return np.concatenate([directions(theta, psi), seam, np.eye(3), -np.eye(3), [[1, -0.0, 0], [-1, -0.0, 0]]])


def test_polar_capped__round_trip_at_poles_seam_and_edges():
    sphere, points = PolarCapped((0.0, 0.0, 0.0), 900), hard_directions()
    pixels, depth = sphere.project(points)
    width, height = sphere.size
    assert ((pixels >= 0) & (pixels <= [width, height])).all()
    assert degrees_between(sphere.unproject(pixels, depth), points).max() < MOST_DEGREES / 1e6
    np.testing.assert_allclose(depth, 1)


@settings(max_examples=300, deadline=None)
@given(ANGLE, ANGLE.map(lambda a: a / 2), st.floats(1e-3, 1e5), st.integers(1, 20_000))
def test_polar_capped__round_trip_of_any_direction(theta, psi, distance, height):
    sphere = PolarCapped((1.0, -2.0, 3.0), height)
    point = directions(np.array([theta]), np.array([psi])) * distance + sphere.centre
    back = sphere.unproject(*sphere.project(point))
    assert degrees_between(back - sphere.centre, point - sphere.centre).max() < MOST_DEGREES
    np.testing.assert_allclose(np.linalg.norm(back - sphere.centre), distance, rtol=1e-9)


def test_polar_capped__the_seam_wraps_and_no_band_lies_on_the_caps():
    """Without the fraction, azimuths below 0 would fall onto the caps' columns."""
    sphere = PolarCapped((0.0, 0.0, 0.0), 100)
    theta = np.linspace(-np.pi, np.pi, 1001)
    column = sphere.project(directions(theta, np.zeros(1001)))[0][:, 0]
    assert column.min() >= 200 and column.max() < 600
    below, above = sphere.project(directions(np.array([-1e-6, 1e-6]), np.zeros(2)))[0][:, 0]
    assert 600 - below < 1e-3 and above - 200 < 1e-3


def test_polar_capped__agrees_with_the_paper_s_forward_map():
    """Equations 1 to 3, written out for texels of each chart."""
    height = 64
    sphere = PolarCapped((0.0, 0.0, 0.0), height)
    s, t = np.meshgrid((np.arange(6 * height) + 0.5) / (6 * height), (np.arange(height) + 0.5) / height)
    expected = np.empty((*s.shape, 3))
    for low, high, middle, sign in ((0, 1 / 6, 0.5, -1), (1 / 6, 2 / 6, 1.5, 1)):
        cap = (s > low) & (s <= high)
        u, v = 6 * s[cap] - middle, t[cap] - 0.5
        r = np.hypot(u, v)
        expected[cap] = np.stack(
            [u / r * np.sin(np.pi * r / 2), v / r * np.sin(np.pi * r / 2), sign * np.cos(np.pi * r / 2)], axis=-1
        )
    band = s > 2 / 6
    expected[band] = directions((1.5 * s[band] - 0.5) * 2 * np.pi, t[band] * np.pi / 2 - np.pi / 4)
    pixels = np.stack([s * 6 * height, t * height], axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(sphere.unproject(pixels, np.ones(len(pixels))), expected.reshape(-1, 3), atol=1e-13)


def test_polar_capped__the_printed_inverse_is_wrong():
    """What the paper prints for the bottom cap, 2 pi arccos(z), lands elsewhere on most of it."""
    point = directions(np.radians([30.0]), np.radians([-60.0]))
    r = 2 * np.pi * np.arccos(point[0, 2])
    printed = ((point[0, 0] * r / np.sin(np.pi * r / 2) + 0.5) / 6 * 6 * 900, 900 * (point[0, 1] * r + 0.5) / 6)
    right = PolarCapped((0.0, 0.0, 0.0), 900).project(point)[0][0]
    assert np.abs(np.array(printed) - right).max() > 100


def test_polar_capped__texels_cover_the_sphere_and_differ_by_142_at_most():
    sphere = PolarCapped((0.0, 0.0, 0.0), 200)
    columns, rows = np.meshgrid(np.arange(1200) + 0.5, np.arange(200) + 0.5)
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2)
    owned = np.abs(sphere.project(sphere.unproject(pixels, np.ones(len(pixels))))[0] - pixels).max(axis=1) < 1e-6
    area = sphere.footprint(pixels)
    np.testing.assert_allclose(area[owned].sum(), 4 * np.pi, rtol=5e-4)  # texels at the rims of caps are in or out
    assert area[owned].max() / area[owned].min() < 1.42


@pytest.mark.parametrize("camera", [PolarCapped((3.0, 2.0, 1.0), 300), a_pinhole()], ids=["polar-capped", "pinhole"])
def test_footprint__is_the_area_between_the_directions_of_a_pixel_s_corners(camera):
    rng = np.random.default_rng(5)
    width, height = camera.size
    pixels = rng.uniform(1, [width - 1, height - 1], (400, 2))
    if isinstance(camera, PolarCapped):  # no chart's edge within a pixel
        pixels = pixels[np.abs(pixels[:, 0] % height - height / 2) < height / 2 - 1]
    corners = [
        camera.unproject(pixels + offset, np.ones(len(pixels))) - camera.centre
        for offset in np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 8
    ]
    corners = [c / np.linalg.norm(c, axis=1, keepdims=True) for c in corners]
    area = np.linalg.norm(np.cross(corners[2] - corners[0], corners[3] - corners[1]), axis=1) / 2 * 16
    np.testing.assert_allclose(camera.footprint(pixels), area, rtol=2e-4)


@settings(max_examples=100, deadline=None)
@given(st.floats(0.5, 639.5), st.floats(0.5, 479.5), st.floats(1e-2, 1e4))
def test_pinhole__round_trip_far_from_zero(x, y, depth):
    camera = a_pinhole()
    point = camera.unproject(np.array([[x, y]]), np.array([depth]))
    pixels, found = camera.project(point)
    # 5e6 in float64 is known to 1e-9, which a depth of 0.01 shows as 1e-7 of an angle
    np.testing.assert_allclose(pixels, [[x, y]], atol=520 * 4e-9 / depth + 1e-6)
    np.testing.assert_allclose(found, [depth], rtol=4e-9 / depth + 1e-9)


def test_projections__their_own_centre_and_what_lies_behind_a_pinhole_have_no_pixel():
    camera, sphere = a_pinhole(), PolarCapped((1.0, 2.0, 3.0), 10)
    behind = np.array(camera.centre) - np.array(camera.camera.rotation[2])
    assert np.isnan(camera.project(np.array([behind, camera.centre]))[0]).all()
    pixels, depth = sphere.project(np.array([sphere.centre]))
    assert np.isnan(pixels).all() and np.isnan(depth).all()


def test_height_for__is_no_coarser_than_asked():
    assert height_for(np.radians(0.1)) == 900
    for step in np.random.default_rng(2).uniform(1e-4, 2, 50):
        assert np.pi / 2 / height_for(step) <= step * (1 + 1e-8)
