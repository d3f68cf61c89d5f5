"""What a view sees of points, and pictures against them."""

from __future__ import annotations

import numpy as np

from renderer.evaluate.stations.seen_points import seen_points
from storage.packed.schema import Camera

VIEW = Camera("v", 40, 30, 20.0, 20.0, 20.0, 15.0, ((1.0, 0, 0), (0, 1, 0), (0, 0, 1)), (5.0, 0.0, 0.0))


def test_seen_points__are_before_the_eye_inside_the_picture_and_hidden_by_none():
    points = np.array([[0, 0, 4], [0, 0, 5], [0, 0, -4], [9, 0, 4], [0.8, 0, 4], [0, 0, 4.1]]) + [5.0, 0, 0]
    found = seen_points(VIEW, points)
    assert sorted(found.rows.tolist()) == [0, 4, 5]  # 1 is hidden, 2 behind, 3 beside it; 5 is as good as 0
    assert found.pixel[found.rows.tolist().index(4)].tolist() == [15, 24]


def test_seen_points__psnr_is_over_the_points_whose_pixels_are_covered():
    points = np.array([[0, 0, 4], [0.8, 0, 4]]) + [5.0, 0, 0]
    found = seen_points(VIEW, points)
    rgb, covered = np.zeros((30, 40, 3), np.uint8), np.ones((30, 40), bool)
    colors = np.array([[255, 255, 255], [0, 0, 0]], np.uint8)
    db, n = found.psnr_db(rgb, colors, covered)
    assert n == 2 and abs(db - 10 * np.log10(2)) < 1e-9
    covered[15, 20] = False
    assert found.psnr_db(rgb, colors, covered)[1] == 1
    assert found.psnr_db(rgb, colors, np.zeros_like(covered)) == (None, 0)
