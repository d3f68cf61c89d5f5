"""Spacing of a scan: of a large one its tasks tell what the median is taken of."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.chunks import median_split
from pipeline.splats.boxes import store_boxes
from pipeline.stages.points import neighbours as stage
from pipeline.summaries import Points, Spacings
from storage.work import arrays, work
from tests.pipeline.stages.points.test_partition import done

N = 2 * arrays.BLOCK + 100


def test_neighbours__of_a_large_scan_a_sample_that_tasks_tell_has_the_median(tmp_path, monkeypatch):
    position = np.random.default_rng(0).uniform(0, 1, (N, 3)) ** 2
    position = position[median_split(position)]
    points = tmp_path / "points"
    work.begin(points)
    arrays.store(points, "position", position)
    arrays.store(points, "normal", np.tile(np.float32([0, 0, 1]), (N, 1)))
    boxes = [position[at : at + arrays.BLOCK] for at in range(0, N, arrays.BLOCK)]
    store_boxes(points, np.array([b.min(axis=0) for b in boxes]), np.array([b.max(axis=0) for b in boxes]))
    work.complete(points, Points(N, (0, 0, 0), (N,)), 0.0)
    whole = work.summary(done(stage.Neighbourhoods(points), tmp_path / "all"), Spacings).median_spacing
    assert whole == np.median(arrays.read(tmp_path / "all", "spacing"))
    monkeypatch.setattr(stage, "MOST_SPACINGS", N - 1)
    monkeypatch.setattr(stage, "SAMPLED", N // 4)
    sampled = work.summary(done(stage.Neighbourhoods(points), tmp_path / "some"), Spacings).median_spacing
    assert sampled == pytest.approx(whole, rel=0.03) and sampled != whole
    assert (
        stage.Neighbourhoods(points).finalise(tmp_path / "all", [stage.SpacingBlock(1, 0, (2.0,))]).median_spacing
        == 2.0
    )
