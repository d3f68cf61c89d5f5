"""Patches against a slow float64 twin and against an analytic texture."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.texture.patches import Block, centred, make_patches, patch_errors, patches_again
from pipeline.texture.projection import homographies, is_in_front, project_corners
from pipeline.texture.resample import (
    PATCH_DIM,
    PROBES,
    Window,
    disc_weights,
    resample_patches,
    resampling_error,
    window_bounds,
)
from storage.packed.schema import NO_CAMERA, Camera
from tests import reference

CAMERA = Camera("c", 120, 90, 100.0, 110.0, 60.0, 45.0, ((1, 0, 0), (0, 1, 0), (0, 0, 1)), (0.0, 0.0, 0.0))
ORIGIN = (0.0, 0.0, 0.0)


def photo(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (90, 120, 3), dtype=np.uint8)


def tilted(n: int, depth: float = 4.0, seed: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres before the camera and orthonormal tangents, tilted at random by up to 60 degrees."""
    rng = np.random.default_rng(seed)
    centre = np.column_stack([rng.uniform(-1, 1, (n, 2)), rng.uniform(0.8, 1.2, n) * depth])
    normal = rng.normal(0, 0.6, (n, 3)) - [0, 0, 1]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    u = np.cross([0, 1.0, 0], normal)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return centre, u, np.cross(normal, u)


def test_projection__the_centre_and_corners_land_where_the_camera_sees_them():
    centre, u, v = tilted(20)
    h = homographies(CAMERA, ORIGIN, centre, u, v, 0.2)
    corners = project_corners(h)
    for i, (sx, sy) in enumerate([(-1, -1), (-1, 1), (1, -1), (1, 1)]):
        world = centre + 0.2 * (sx * u + sy * v)
        np.testing.assert_allclose(corners[:, i, 0], 100 * world[:, 0] / world[:, 2] + 60, atol=1e-9)
        np.testing.assert_allclose(corners[:, i, 1], 110 * world[:, 1] / world[:, 2] + 45, atol=1e-9)


def test_projection__a_scan_far_from_the_origin_projects_as_well():
    centre, u, v = tilted(20)
    far = (4.5e5, 5.4e6, 100.0)
    moved = Camera(**{**CAMERA.__dict__, "centre": far})
    near, away = (homographies(c, o, centre, u, v, 0.2) for c, o in ((CAMERA, ORIGIN), (moved, far)))
    np.testing.assert_allclose(project_corners(near), project_corners(away), atol=1e-6)


def test_projection__squares_that_reach_behind_the_camera_are_told():
    u, v = np.array([[0.0, 0, 1]] * 3), np.array([[0.0, 1, 0]] * 3)
    centre = np.array([[0.3, 0, 1.0], [0.3, 0, 0.1], [0.3, 0, -2.0]])
    assert is_in_front(homographies(CAMERA, ORIGIN, centre, u, v, 0.2)).tolist() == [True, False, False]


@pytest.mark.parametrize("radius", [0.001, 0.2, 0.4])
def test_resample__agrees_with_the_float64_twin(radius):
    centre, u, v = tilted(12)
    h = homographies(CAMERA, ORIGIN, centre, u, v, radius)
    patches = resample_patches(Window(photo(), 0, 0), h).reshape(-1, 32, 32, 3)
    for patch, homography in zip(patches, h):
        assert np.abs(patch - reference.patch_of(photo(), homography)).max() <= 0.51


def test_resample__a_window_gives_what_the_whole_photo_gives():
    centre, u, v = tilted(12)
    h = homographies(CAMERA, ORIGIN, centre, u, v, 0.3)
    left, top, right, bottom = window_bounds(project_corners(h), 120, 90)
    assert (right - left) * (bottom - top) < 120 * 90
    part = Window(photo()[top:bottom, left:right], left, top)
    assert (resample_patches(part, h) == resample_patches(Window(photo(), 0, 0), h)).all()


def test_resample__beyond_the_photo_its_edge_goes_on():
    h = homographies(CAMERA, ORIGIN, np.array([[2.7, 0, 4.0]]), np.array([[1.0, 0, 0]]), np.array([[0.0, 1, 0]]), 0.4)
    patch = resample_patches(Window(photo(), 0, 0), h).reshape(32, 32, 3)
    assert (patch[:, -1] == patch[:, -8]).all() and (patch[:, 0] != patch[:, -1]).any()


def test_resample__a_texel_of_many_pixels_is_their_mean():
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (2048, 2048, 3), dtype=np.uint8)
    camera = Camera("big", 2048, 2048, 1000.0, 1000.0, 1024.0, 1024.0, CAMERA.rotation, CAMERA.centre)
    h = homographies(camera, ORIGIN, np.array([[0.0, 0, 1]]), np.array([[1.0, 0, 0]]), np.array([[0.0, 1, 0]]), 0.512)
    patch = resample_patches(Window(noise, 0, 0), h).reshape(32, 32, 3).astype(float)
    boxes = noise[512:1536, 512:1536].reshape(32, 32, 32, 32, 3).mean(axis=(1, 3))
    assert np.abs(patch - boxes).max() < 2


def test_resample__the_probe_error_is_small_for_smooth_and_large_for_rough_photos():
    centre, u, v = tilted(50)
    h = homographies(CAMERA, ORIGIN, centre, u, v, 0.1)
    y, x = np.mgrid[:90, :120]
    smooth = np.stack([x * 2, y * 2, x + y], axis=2).astype(np.uint8)
    errors = []
    for picture in (smooth, photo()):
        window = Window(picture, 0, 0)
        errors.append(resampling_error(resample_patches(window, h), np.arange(50), window, h, 0).mean() / (3 * PROBES))
    assert -10 * np.log10(errors[0]) > 55 > -10 * np.log10(errors[1]) > 30


def windows(photos):
    return lambda i, left, top, right, bottom: photos[i][top:bottom, left:right]


def test_patches__each_splat_is_sampled_from_its_own_camera():
    centre, u, v = tilted(30)
    cameras = (CAMERA, Camera(**{**CAMERA.__dict__, "name": "d", "centre": (0.5, 0.0, 0.0)}))
    photos, camera = [photo(1), photo(2)], np.arange(30, dtype=np.uint16) % 2
    camera[7] = NO_CAMERA
    color = np.full((30, 3), (10, 20, 30), np.uint8)
    block = Block(cameras, windows(photos), ORIGIN, centre, (u, v), 0.2, camera, color)
    made = make_patches(block, 0)
    for i in (0, 1, 28, 29):
        h = homographies(cameras[i % 2], ORIGIN, centre[i : i + 1], u[i : i + 1], v[i : i + 1], 0.2)
        assert (made.texel[i] == resample_patches(Window(photos[i % 2], 0, 0), h)[0]).all()
    assert (made.texel[7].reshape(-1, 3) == (10, 20, 30)).all() and made.energy[7] == 0
    assert made.n_probes == 29 * 3 * PROBES
    wanted, memory = np.array([0, 3, 7, 28]), np.empty((30, PATCH_DIM), np.uint8)
    for rows in (wanted, np.arange(30)):
        assert (patches_again(block, rows, True, memory) == made.texel[rows]).all()


def test_patches__average_and_energy_are_those_of_the_texels():
    centre, u, v = tilted(30)
    camera = np.zeros(30, np.uint16)
    black = np.zeros((30, 3), np.uint8)
    made = make_patches(Block((CAMERA,), windows([photo()]), ORIGIN, centre, (u, v), 0.2, camera, black), 0)
    mean = made.texel.reshape(30, -1, 3).mean(axis=1)
    assert np.abs(made.average - mean).max() <= 0.5
    rows = made.texel.reshape(30, -1, 3) / 255.0 - made.average[:, None] / 255.0
    np.testing.assert_allclose(made.energy, (rows**2).sum(axis=(1, 2)), rtol=1e-5)
    np.testing.assert_allclose(centred(made.texel, made.average), rows.reshape(30, -1), atol=1e-6)


def test_patches__errors_are_clamped_and_weighted():
    rng = np.random.default_rng(3)
    texel, average = (
        rng.integers(0, 256, (20, PATCH_DIM), dtype=np.uint8),
        rng.integers(0, 256, (20, 3), dtype=np.uint8),
    )
    added = rng.normal(0, 0.5, (20, PATCH_DIM)).astype(np.float32)
    shown = np.clip(added.reshape(20, -1, 3) + average[:, None] / 255.0, 0, 1).reshape(20, -1)
    squared = (shown - texel / 255.0) ** 2
    plain, weighted = patch_errors(texel, average, added)
    assert plain == pytest.approx(squared.sum(), rel=1e-5)
    assert weighted == pytest.approx((squared * disc_weights()).sum(), rel=1e-5)


def test_patches__disc_weights_are_one_minus_distance_squared():
    weight = disc_weights().reshape(32, 32, 3)
    assert weight[0, 0, 0] == 0 and weight[16, 16, 1] == pytest.approx(1 - 2 / 1024)
    assert weight.mean() == pytest.approx(np.pi / 8, rel=1e-2)
