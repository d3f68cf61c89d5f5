"""Mip levels: which ones views reach, and that they are those that the renderer looks up."""

import numpy as np
import pytest

from pipeline.effects.mip_levels import (
    ATOM_AREA,
    BINS_A_LEVEL,
    DEEPEST,
    RARE,
    TO_COARSER,
    levels_seen,
    needed,
    stored_sizes,
)
from renderer.splats.glsl import shader_source
from storage.packed.schema import ATOM_SIZES, MIP_SIZES
from tests.scenes import camera_looking

CAMERA = camera_looking((0, 0, 0), (0, 1, 0), (640, 480), (500, 520))


def test_levels__are_those_of_the_image_of_the_tangent_square():
    """Against the area of a small square projected corner by corner."""
    rng = np.random.default_rng(0)
    centre = rng.uniform([-1, 2, -1], [1, 9, 1], (50, 3))
    normal = rng.normal(size=(50, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    found = levels_seen(CAMERA, centre, normal, radius=0.05)
    u = np.cross(normal, [0.3, 0.5, 0.8])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    a, b = 1e-4 * u, 1e-4 * np.cross(normal, u)

    def pixel(point):
        local = point @ np.array(CAMERA.rotation).T
        return local[:, :2] / local[:, 2:] * [500, 520]

    across, down = pixel(centre + a) - pixel(centre), pixel(centre + b) - pixel(centre)
    area = np.abs(across[:, 0] * down[:, 1] - across[:, 1] * down[:, 0]) * (0.05 / 1e-4) ** 2
    np.testing.assert_allclose(found, np.clip(0.5 * np.log2(ATOM_AREA / np.maximum(area, 0.25)), 0, DEEPEST), atol=0.02)


def test_levels__use_the_constant_of_the_shader():
    source = shader_source("attribute.vert.glsl")
    assert "const float ATOM_AREA = 0.5 * 16.0 * 16.0;" in source and ATOM_AREA == 0.5 * 16 * 16
    assert f"const float TO_COARSER = {TO_COARSER};" in source


def test_levels__of_what_lies_behind_are_not_known():
    assert np.isnan(levels_seen(CAMERA, np.array([[0.0, -2, 0]]), np.array([[0.0, 1, 0]]), 0.1)).all()


def test_needed__leaves_out_no_more_than_what_is_rare_on_either_side():
    rng = np.random.default_rng(1)
    level = rng.uniform(0.7, 3.3, 20_000)
    histogram = np.histogram(level, DEEPEST * BINS_A_LEVEL, (0, DEEPEST))[0]
    low, high = needed(histogram)
    assert low == pytest.approx(0.7, abs=0.1) and high == pytest.approx(3.3, abs=0.1)
    assert (level < low).mean() <= RARE and (level > high).mean() <= RARE
    assert needed(np.zeros_like(histogram)) == (0, DEEPEST)


@pytest.mark.parametrize("finest, coarsest", [(0.0, 0.4), (0.2, 1.7), (1.3, 2.0), (2.9, 4.8), (4.2, 4.3)])
def test_stored__sizes_hold_every_level_that_views_reach(finest, coarsest):
    found = {"finest": finest, "coarsest": coarsest, "farthest": 3.0}
    for blended in (False, True):
        largest, smallest = stored_sizes(found, False, None, blended)
        assert largest in ATOM_SIZES and smallest in MIP_SIZES and smallest <= largest
        looked_up = (finest, coarsest) if blended else np.floor(np.array([finest, coarsest]) + 0.5)
        assert MIP_SIZES.index(largest) <= max(looked_up[0], MIP_SIZES.index(ATOM_SIZES[-1])) or coarsest - finest < 1
        assert MIP_SIZES.index(smallest) >= min(looked_up[1], DEEPEST) or coarsest - finest < 1
        assert stored_sizes(found, False, 300.0, blended)[1] <= smallest


@pytest.mark.parametrize("finest, coarsest, size", [(0.0, 0.4, 32), (0.7, 1.2, 16), (1.4, 1.9, 8)])
def test_stored__one_level_where_views_span_less_than_one(finest, coarsest, size):
    assert stored_sizes({"finest": finest, "coarsest": coarsest, "farthest": 3.0}, False, None) == (size, size)


def test_stored__off_by_request_is_one_level_and_on_by_request_all():
    assert stored_sizes(None, False, 9.0) == stored_sizes({}, False, None) == (32, 32)
    assert stored_sizes({"finest": 2.0, "coarsest": 2.1, "farthest": 1.0}, True, None) == (32, 1)
