"""The out-of-core median split gives what the one in memory gives."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.chunks import median_split
from pipeline.numerics.hashing import uniform_hash
from pipeline.stages.points import partition
from pipeline.stages.points.partition import Partition
from storage.errors import InvalidScan
from storage.work import arrays, work


def ingested(folder, position: np.ndarray):
    """A folder as the ingest leaves it, each point's colour telling its place in the file."""
    work.begin(folder)
    index = np.arange(len(position))
    color = np.column_stack([index & 255, index >> 8 & 255, index >> 16]).astype(np.uint8)
    for name, rows in (("position", position), ("color", color)):
        arrays.store(folder, name, rows)
    work.complete(
        folder,
        {"n_points": len(position), "low": position.min(axis=0).tolist(), "high": position.max(axis=0).tolist()},
        0.0,
    )
    return folder


def clouds() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "cloud": rng.normal(size=(40_000, 3)),
        "ties": rng.integers(0, 5, (40_000, 3)).astype(float),
        "all equal": np.full((20_000, 3), 7.0),
        "one heavy value": np.where(rng.random((40_000, 3)) < 0.9, 0.0, rng.normal(size=(40_000, 3))),
        "huge and tiny": rng.normal(size=(40_000, 3)) ** 15 * 1e9,
        "georeferenced": rng.normal(size=(40_000, 3)) + [4.5e5, 5.4e6, 100],
    }


@pytest.mark.parametrize("kind", clouds())
def test_partition__out_of_core_is_the_same_order_as_in_memory(kind, tmp_path, monkeypatch):
    monkeypatch.setattr(partition, "IN_MEMORY", 8192)
    monkeypatch.setattr(partition, "PIECE", 3000)
    monkeypatch.setattr(partition, "BINS", 16)
    position = clouds()[kind]
    stage, folder = Partition(ingested(tmp_path / "ingest", position)), tmp_path / "partition"
    work.begin(folder)
    assert stage.init(folder) == 1
    summary = stage.finalise(folder, [stage.run(folder, 0)])
    origin = np.array(summary["origin"])
    order = median_split(position - origin)
    color = arrays.read(folder, "color").astype(np.int64)
    assert (color[:, 0] + 256 * color[:, 1] + 65536 * color[:, 2] == order).all()
    assert (arrays.read(folder, "point") == order).all()
    np.testing.assert_array_equal(arrays.read(folder, "position"), (position - origin)[order])
    assert not list(folder.glob("scratch*"))
    block = arrays.read(folder, "position", 0, arrays.BLOCK)
    np.testing.assert_array_equal(summary["block_low"][0], block.min(axis=0))


def kept_by(density: float, position: np.ndarray, folder) -> tuple[np.ndarray, dict]:
    """Places in the file of the points that are kept, in chunk order, and the summary."""
    stage, made = Partition(ingested(folder / "ingest", position), density), folder / "partition"
    work.begin(made)
    stage.init(made)
    summary = stage.finalise(made, [stage.run(made, 0)])
    return arrays.read(made, "point"), summary


@pytest.mark.parametrize("density", [0.5, 0.1])
def test_partition__density_keeps_that_share_from_everywhere(density, tmp_path):
    position = clouds()["cloud"]
    point, summary = kept_by(density, position, tmp_path)
    assert len(point) == summary["n_splats"] == pytest.approx(density * len(position), rel=0.05)
    assert len(np.unique(point)) == len(point)
    assert np.histogram(point, 8, (0, len(position)))[0] == pytest.approx(density * len(position) / 8, rel=0.15)
    np.testing.assert_allclose(arrays.read(tmp_path / "partition", "position"), position[point] - summary["origin"])
    color = arrays.read(tmp_path / "partition", "color").astype(np.int64)
    assert (color @ [1, 256, 65536] == point).all()


def test_partition__a_thinner_scan_is_part_of_a_denser_one(tmp_path):
    few, many = (set(kept_by(d, clouds()["cloud"], tmp_path / str(d))[0].tolist()) for d in (0.1, 0.5))
    assert few < many


def test_partition__what_is_kept_tells_nothing_of_what_is_learned_from(tmp_path):
    point, _ = kept_by(0.5, clouds()["cloud"], tmp_path)
    assert (uniform_hash(point, 0) < 0.5).mean() == pytest.approx(0.5, abs=0.02)


def test_partition__a_density_that_keeps_nothing_is_refused(tmp_path):
    with pytest.raises(InvalidScan, match="keeps none of 20,000 points; allowed: 5e-05 and more"):
        kept_by(1e-9, clouds()["all equal"], tmp_path)
