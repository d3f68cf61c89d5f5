"""Patches against a float64 ray cast of an analytic texture, and the flags where nothing is seen. Bounds:
docs/NUMERICS.md."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.splats.cameras import best_cameras
from pipeline.texture.patches import Block, make_patches
from pipeline.texture.projection import homographies, is_in_front, is_whole, project_corners
from pipeline.texture.resample import Window, resample_patches, window_bounds
from storage.packed.schema import NO_CAMERA, Camera
from tests import reference

LEVEL = 1 / 255
EYE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
CAMERA = Camera("c", 2400, 1800, 2000.0, 2000.0, 1200.0, 900.0, EYE, (0.0, 0.0, 0.0))


def seen_color(px: np.ndarray, py: np.ndarray) -> np.ndarray:
    """What stands at photo coordinates, (..., 3) in 0..255: slow waves, so that bilinear lookups are exact to 0.01."""
    waves = [np.sin(px / 90 + 1), np.cos(py / 80 - px / 200), np.sin((px + py) / 110)]
    return 127.5 + 100 * np.stack(waves, axis=-1)


def photo_of(camera: Camera) -> np.ndarray:
    px, py = np.meshgrid(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
    return np.rint(seen_color(px, py)).astype(np.uint8)


PHOTO = photo_of(CAMERA)


def frame_at(angle_degrees: float, turn: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """Tangents of a splat before the camera whose normal makes this angle with the view."""
    angle = np.radians(angle_degrees)
    across = np.array([np.cos(turn), np.sin(turn), 0.0])
    into = np.cross([0, 0, 1.0], across)
    return across, np.cos(angle) * into + np.sin(angle) * np.array([0, 0, 1.0])


def patch_and_ray_cast(camera, centre, u, v, radius, origin=(0.0, 0.0, 0.0)):
    h = homographies(camera, origin, centre[None], u[None], v[None], radius)
    bounds = window_bounds(project_corners(h), camera.width_px, camera.height_px)
    pixels = PHOTO[bounds[1] : bounds[3], bounds[0] : bounds[2]]
    patch = resample_patches(Window(pixels, bounds[0], bounds[1]), h).reshape(32, 32, 3)
    cast = reference.cast_patch(camera, centre + origin, radius * u, radius * v, seen_color)
    return patch, cast, bool(is_whole(h, camera.width_px, camera.height_px)[0])


@pytest.mark.parametrize("angle", [0, 30, 60, 80, 85, 89, 89.9])
def test_projection__grazing_views_are_within_1_of_255(angle):
    u, v = frame_at(angle)
    for depth, radius in ((5.0, 0.02), (5.0, 0.2), (20.0, 1.0)):
        patch, cast, whole = patch_and_ray_cast(CAMERA, np.array([0.1, -0.2, depth]), u, v, radius)
        assert whole and np.abs(patch - cast).max() <= 255 * LEVEL + 0.05


@pytest.mark.parametrize("footprint_px", [0.01, 0.3, 7, 32, 100, 1000])
def test_projection__footprints_of_any_size_are_within_1_of_255(footprint_px):
    u, v = frame_at(20)
    depth = 10.0
    radius = footprint_px * depth / (2 * CAMERA.fx_px)
    patch, cast, whole = patch_and_ray_cast(CAMERA, np.array([0.3, 0.2, depth]), u, v, radius)
    assert whole and np.abs(patch - cast).max() <= 255 * LEVEL + 0.05


def test_projection__one_lookup_a_texel_breaks_where_a_texel_covers_many_pixels():
    """The naive formulation, on a photo of fine stripes: what a texel of 31 pixels shows is their mean."""
    u, v = frame_at(0, turn=0.0)
    stripes = np.where(np.arange(2400) % 5 < 2, 255, 0).astype(np.uint8)[None, :, None] * np.ones(
        (1800, 1, 3), np.uint8
    )
    h = homographies(CAMERA, (0.0, 0.0, 0.0), np.array([[0.0, 0, 10]]), u[None], v[None], 2.5)
    naive = reference.patch_of(stripes, h[0])
    found = resample_patches(Window(stripes, 0, 0), h).reshape(32, 32, 3)
    assert np.abs(naive - 102).max() > 100 and np.abs(found.astype(float) - 102).max() < 10


@pytest.mark.parametrize("change", ["fx != fy", "mirrored", "turned", "far from zero", "principal point outside"])
def test_projection__odd_cameras_are_within_1_of_255(change):
    camera, origin, centre = CAMERA, (0.0, 0.0, 0.0), np.array([0.2, 0.1, 6.0])
    if change == "fx != fy":
        camera = replace(camera, fx_px=4000.0, fy_px=700.0)
    elif change == "mirrored":
        camera = replace(camera, rotation=((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    elif change == "turned":
        turn = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
        camera, centre = replace(camera, rotation=tuple(map(tuple, turn.tolist()))), turn.T @ centre
    elif change == "far from zero":
        origin = (4.5e5, 5.4e6, 100.0)
        camera = replace(camera, centre=origin)
    else:
        camera = replace(camera, cx_px=-3000.0, cy_px=900.0)
        centre = np.array([6 * 4200 / 2000, 0.0, 6.0])
    u, v = frame_at(35)
    if change == "turned":
        u, v = turn.T @ u, turn.T @ v
    patch, cast, whole = patch_and_ray_cast(camera, centre, u, v, 0.1, origin)
    assert whole and np.abs(patch - cast).max() <= 255 * LEVEL + 0.05


def test_projection__far_from_zero_patches_are_those_at_zero():
    u, v = frame_at(40)
    centre = np.array([0.123456789, -0.2, 5.0])
    near = patch_and_ray_cast(CAMERA, centre, u, v, 0.1)[0]
    far = patch_and_ray_cast(replace(CAMERA, centre=(4.5e5, 5.4e6, 100.0)), centre, u, v, 0.1, (4.5e5, 5.4e6, 100.0))[0]
    assert np.abs(near.astype(int) - far).max() <= 1
    naive = reference.float32_homography(CAMERA, centre + [4.5e5, 5.4e6, 100.0], u, v, 0.1, (4.5e5, 5.4e6, 100.0))
    moved_px = np.abs(
        naive[:2, 2] / naive[2, 2]
        - (homographies(CAMERA, (0, 0, 0), centre[None], u[None], v[None], 0.1)[0, :2, 2] / 5.0)
    )
    assert moved_px.max() > 5  # the naive way: absolute coordinates in float32


def test_projection__splats_at_the_photo_s_edge_are_exact_inside_and_flagged():
    u, v = frame_at(10, turn=0.0)
    for x_px, y_px in ((0, 900), (2400, 900), (1200, 0), (1200, 1800), (0, 0)):
        centre = np.array([(x_px - 1200) / 2000, (y_px - 900) / 2000, 1.0]) * 5
        patch, cast, whole = patch_and_ray_cast(CAMERA, centre, u, v, 0.1)
        assert not whole
        at = np.stack(reference.texel_points(CAMERA, centre, 0.1 * u, 0.1 * v), axis=-1)
        inside = ((at > 2) & (at < [2398, 1798])).all(axis=-1)
        assert 100 < inside.sum() < 1000 and np.abs(patch - cast)[inside].max() <= 255 * LEVEL + 0.05
    centre = np.array([0, 0, 5.0])
    assert patch_and_ray_cast(CAMERA, centre, u, v, 0.1)[2]


# --- where nothing is seen
# ----------------------------------------------------------------------------------------------


def hopeless() -> dict[str, tuple[Camera, np.ndarray]]:
    """Cameras and centres of splats of radius 0.1 that they cannot texture."""
    singular = {
        "no depth": ((1.0, 0, 0), (0, 1.0, 0), (0, 0, 0)),
        "rank two": ((1.0, 0, 0), (1.0, 0, 0), (0, 0, 1.0)),
        "nan": ((np.nan, 0, 0), (0, 1.0, 0), (0, 0, 1.0)),
        "inf": ((1.0, 0, 0), (0, np.inf, 0), (0, 0, 1.0)),
    }
    ahead = np.array([0.0, 0, 5])
    return {name: (replace(CAMERA, rotation=r), ahead) for name, r in singular.items()} | {
        "behind": (CAMERA, -ahead),
        "at the eye": (CAMERA, 0 * ahead),
        "around the camera plane": (CAMERA, np.array([0, 0, 0.01])),
        "a corner behind": (CAMERA, np.array([0.0, 0, 0.09])),
        "w near zero": (CAMERA, np.array([0, 0, 1e-300])),
        "beside the photo": (CAMERA, np.array([50.0, 0, 5])),
        "no focal length": (replace(CAMERA, fx_px=0.0), ahead),
        "edge on": (CAMERA, ahead),
    }


@pytest.mark.parametrize("name", hopeless())
def test_projection__what_is_not_seen_is_flagged_and_takes_the_scan_s_colour(name):
    camera, centre = hopeless()[name]
    u, v = frame_at(90 if name == "edge on" else 70, turn=0.0)
    with np.errstate(all="ignore"):
        h = homographies(camera, (0, 0, 0), centre[None], u[None], v[None], 0.1)
        whole = is_whole(h, camera.width_px, camera.height_px)
        assert not whole[0]

        def read(i, left, top, right, bottom):
            return PHOTO[top:bottom, left:right]

        color = np.array([[10, 200, 30]], np.uint8)
        block = Block((camera,), read, (0, 0, 0), centre[None], (u[None], v[None]), 0.1, np.zeros(1, np.uint16), color)
        patches = make_patches(block, 0)
        assert patches.n_flagged == 1
        assert np.isfinite(patches.energy).all() and np.isfinite(patches.resampling_error)
        if not is_in_front(h)[0]:
            assert (patches.texel.reshape(-1, 3) == color).all() and patches.n_probes == 0


@pytest.mark.parametrize("name", [n for n in hopeless() if n not in ("edge on",)])
def test_projection__no_camera_is_chosen_that_cannot_see(name):
    camera, centre = hopeless()[name]
    with np.errstate(all="ignore"):
        best = best_cameras((camera,), centre[None], np.array([[0, 0, -1.0]]), 0.1, np.ones((1, 1), bool))
    assert best[0] == NO_CAMERA or name == "rank two"  # that one has a photo, but no square


def test_projection__a_naive_test_of_the_centre_alone_lets_corners_behind_through():
    u, v = frame_at(70, turn=0.0)
    centre = np.array([[0.0, 0, 0.09]])
    h = homographies(CAMERA, (0, 0, 0), centre, u[None], v[None], 0.1)
    assert h[0, 2, 2] > 0  # the naive test
    corners = h[0, 2] @ np.array([[-1, -1, 1], [-1, 1, 1], [1, -1, 1], [1, 1, 1]]).T
    assert corners.min() < 0 and not is_in_front(h)[0]


def test_projection__the_nearest_corner_may_be_a_twentieth_of_the_distance_away():
    for share, seen, depth in (
        (0.051, True, 1.0),
        (0.049, False, 1.0),
        (0.051, True, 1e3),
        (0.049, False, 1e3),
        (0.051, True, 1e-3),
    ):
        v = np.array([0, 0, 1.0])
        radius = depth * (1 - share)
        h = homographies(CAMERA, (0, 0, 0), np.array([[0, 0, depth]]), np.array([[1.0, 0, 0]]), v[None], radius)
        assert is_in_front(h)[0] == seen
