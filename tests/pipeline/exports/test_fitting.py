"""Colours of Gaussians fitted to pictures: a drawing against a plain one, planted colours, what no picture sees."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.exports.fitting import LOW_PASS_PX2, Target, drawn, fitted, footprints
from pipeline.exports.gaussians import Gaussians
from tests.scenes import camera_looking

ORIGIN = (100.0, -50.0, 7.0)
N = 60


@pytest.fixture(scope="module")
def gaussians():
    """A sheet of flat Gaussians and some behind it, the last behind all cameras."""
    rng = np.random.default_rng(3)
    position = rng.uniform(-0.5, 0.5, (N, 3)) * [1, 0.2, 1]
    position[-1] = [0, -50, 0]
    rotation = rng.normal(size=(N, 4))
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    return Gaussians(
        position, rotation, rng.uniform(0.02, 0.12, (N, 3)), rng.uniform(0, 1, (N, 3)), 0.99, ORIGIN, np.arange(N)
    )


@pytest.fixture(scope="module")
def views():
    at = np.array(ORIGIN)
    return [camera_looking(tuple(at + [x, -2.0, z]), tuple(at), (64, 48)) for x, z in ((0, 0), (0.7, 0.2), (-0.6, 0.5))]


def plainly_drawn(gaussians, view):
    """sum(w_i c_i) in float64 over whole pictures, front to back, by the formulas of the paper."""
    from scipy.spatial.transform import Rotation

    turn = np.array(view.rotation)
    seen = (gaussians.position + np.subtract(ORIGIN, view.centre)) @ turn.T
    y, x = np.mgrid[: view.height_px, : view.width_px] + 0.5
    light, left = np.zeros((view.height_px, view.width_px, 3)), np.ones((view.height_px, view.width_px))
    for i in np.argsort(seen[:, 2]):
        a, b, depth = seen[i]
        if depth <= 0:
            continue
        axes = turn @ Rotation.from_quat(gaussians.rotation[i]).as_matrix() @ np.diag(gaussians.sigma[i])
        f = np.array([[view.fx_px, 0, -view.fx_px * a / depth], [0, view.fy_px, -view.fy_px * b / depth]]) / depth
        inverse = np.linalg.inv(f @ axes @ axes.T @ f.T + LOW_PASS_PX2 * np.eye(2))
        d = np.stack([x - view.fx_px * a / depth - view.cx_px, y - view.fy_px * b / depth - view.cy_px], axis=-1)
        alpha = gaussians.opacity * np.exp(-0.5 * np.einsum("hwi,ij,hwj->hw", d, inverse, d))
        alpha[alpha < 1 / 255] = 0
        light += (left * alpha)[..., None] * gaussians.color[i]
        left *= 1 - alpha
    return light


def test_drawn__as_programs_of_others_draw(gaussians, views):
    for view in views:
        picture = drawn(footprints(gaussians, view), gaussians.color, view)
        assert picture.max() > 0.5
        np.testing.assert_allclose(picture, plainly_drawn(gaussians, view), atol=0.0112)  # exp(-4.5): three sigmas


def targets_of(gaussians, views):
    pictures = [drawn(footprints(gaussians, view), gaussians.color, view) for view in views]
    return [Target(v, np.round(255 * p).astype(np.uint8), p.max(axis=2) > 0) for v, p in zip(views, pictures)]


def test_fitted__finds_planted_colours_and_keeps_those_that_nothing_sees(gaussians, views):
    targets, grey = targets_of(gaussians, views), replace(gaussians, color=np.full((N, 3), 0.5))
    fit = fitted(grey, targets, 30)
    assert fit.error < 1 and fit.error < fit.error_before / 1000
    assert np.median(np.abs(fit.gaussians.color - gaussians.color)[:-1]) < 0.01
    np.testing.assert_array_equal(fit.gaussians.color[-1], 0.5)
    for name in ("position", "rotation", "sigma"):
        np.testing.assert_array_equal(getattr(fit.gaussians, name), getattr(gaussians, name))


def test_fitted__each_step_is_nearer_and_the_same_twice(gaussians, views):
    targets, grey = targets_of(gaussians, views), replace(gaussians, color=np.full((N, 3), 0.5))
    fits = [fitted(grey, targets, steps) for steps in (0, 1, 3, 3)]
    assert fits[0].error == fits[0].error_before > 2 * fits[1].error > 4 * fits[2].error
    np.testing.assert_array_equal(fits[0].gaussians.color, grey.color)
    assert fits[2].gaussians.color.tobytes() == fits[3].gaussians.color.tobytes()
    assert fits[2].gaussians.color.min() >= 0 and fits[2].gaussians.color.max() <= 1


def test_fitted__pixels_that_say_nothing_have_no_part(gaussians, views):
    grey = replace(gaussians, color=np.full((N, 3), 0.5))
    targets = [replace(t, counts=np.zeros_like(t.counts)) for t in targets_of(gaussians, views)]
    np.testing.assert_array_equal(fitted(grey, targets, 3).gaussians.color, grey.color)
