"""Points in order: the same whether a leaf fits into memory or not, and whoever deals out the file."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree

from pipeline.execution.task import run_task
from pipeline.geometry.chunks import median_split
from pipeline.geometry.thinning import thinned
from pipeline.numerics.hashing import uniform_hash
from pipeline.splats.boxes import boxes_of
from pipeline.stages.points import grid_counts, kept, partition, split_on_disk
from pipeline.stages.points.grid_counts import GridCounts
from pipeline.stages.points.kept import n_kept
from pipeline.stages.points.leaves import DealtLeaves
from pipeline.stages.points.partition import OrderedPart, Partition
from pipeline.stages.points.thin import Thin
from pipeline.summaries import Points, ScanRead
from storage.errors import InvalidScan
from storage.packed.schema import GROUP
from storage.work import arrays, work

N = 20 * GROUP + 77


def scan_read(**figures) -> ScanRead:
    """The summary of an ingest of points alone."""
    nothing = dict.fromkeys(("cameras", "stations", "warnings"), ())
    return ScanRead(
        format="ply",
        unit="m",
        n_dropped=0,
        intensity_range=None,
        has_visibility=False,
        **nothing,
        has_colors=True,
        **figures,
    )


def ingested(folder: Path, position: np.ndarray) -> Path:
    """A folder as the ingest leaves it, each point's colour telling its place in the file."""
    work.begin(folder)
    index = np.arange(len(position))
    color = np.column_stack([index & 255, index >> 8 & 255, index >> 16]).astype(np.uint8)
    finite = position[np.isfinite(position).all(axis=1)]
    for name, rows in (("position", position), ("color", color), ("sample", finite[::7])):
        arrays.store(folder, name, rows)
    low, high = finite.min(axis=0).tolist(), finite.max(axis=0).tolist()
    work.complete(folder, scan_read(n_points=len(finite), n_read=len(position), low=low, high=high), 0.0)
    return folder


def clouds() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    holes = rng.normal(size=(N, 3))
    holes[rng.random(N) < 0.3] = np.nan
    return {
        "cloud": rng.normal(size=(N, 3)),
        "ties": rng.integers(0, 5, (N, 3)).astype(float),
        "all equal": np.full((N, 3), 7.0),
        "one heavy value": np.where(rng.random((N, 3)) < 0.9, 0.0, rng.normal(size=(N, 3))),
        "huge and tiny": rng.normal(size=(N, 3)) ** 15 * 1e9,
        "georeferenced": rng.normal(size=(N, 3)) + [4.5e5, 5.4e6, 100],
        "a line": np.outer(rng.random(N), [1.0, 2.0, 3.0]),
        "some not finite": holes,
    }


def done(stage, folder: Path, order=lambda n: range(n)) -> Path:
    """Run a stage's tasks in an order, and make it complete."""
    work.begin(folder)
    n = stage.init(folder)
    results = {i: stage.run(folder, i) for i in order(n)}
    work.complete(folder, stage.finalise(folder, [results[i] for i in range(n)]), 0.0)
    return folder


def through_leaves(ingest: Path, folder: Path, density: float = 1.0, order=lambda n: range(n)) -> Path:
    thinned = done(Thin(ingest, density), folder / "thin", order) if density < 1 else None
    counts = done(GridCounts(ingest, thinned), folder / "counts", order)
    dealt = done(DealtLeaves(ingest, counts, thinned), folder / "dealt", order)
    return done(Partition(ingest, thinned, counts, dealt), folder / "partition", order)


def place_of(folder: Path) -> np.ndarray:
    """Places in the file, in chunk order, told by the colours."""
    return arrays.read(folder, "color").astype(np.int64) @ [1, 256, 65536]


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(partition, "IN_MEMORY", 4 * GROUP)
    monkeypatch.setattr(grid_counts, "IN_MEMORY", 4 * GROUP)
    monkeypatch.setattr(kept, "PART", 30_000)
    monkeypatch.setattr(split_on_disk, "PIECE", 3000)
    monkeypatch.setattr(split_on_disk, "BINS", 16)


@pytest.mark.parametrize("kind", clouds())
def test_partition__out_of_core_is_the_same_order_as_in_memory(kind, tmp_path, small):
    position = clouds()[kind]
    folder = done(Partition(ingested(tmp_path / "ingest", position)), tmp_path / "partition")
    summary = work.summary(folder, Points)
    origin = np.array(summary.origin)
    kept = np.flatnonzero(np.isfinite(position).all(axis=1))
    order = kept[median_split(position[kept] - origin)]
    assert (place_of(folder) == order).all()
    assert (arrays.read(folder, "point") == order).all()
    np.testing.assert_array_equal(arrays.read(folder, "position"), (position - origin)[order])
    assert not list(folder.rglob("*.partial"))
    for i in range(arrays.n_blocks(len(kept))):
        block = arrays.read(folder, "position", *arrays.block_range(i, len(kept)))
        np.testing.assert_array_equal(boxes_of(folder)[0][i], block.min(axis=0))
        np.testing.assert_array_equal(boxes_of(folder)[1][i], block.max(axis=0))


@pytest.mark.parametrize("kind", clouds())
def test_partition__leaves_hold_every_point_once_with_all_that_it_has(kind, tmp_path, small):
    position = clouds()[kind]
    folder = through_leaves(ingested(tmp_path / "ingest", position), tmp_path)
    place = place_of(folder)
    assert np.sort(place).tolist() == np.flatnonzero(np.isfinite(position).all(axis=1)).tolist()
    assert (arrays.read(folder, "point") == place).all()
    summary = work.summary(folder, Points)
    np.testing.assert_array_equal(arrays.read(folder, "position"), position[place] - summary.origin)
    assert len(boxes_of(folder)[0]) == arrays.n_blocks(len(place))
    for start, stop in zip(starts := arrays.read(tmp_path / "counts", "start"), starts[1:]):
        inside = np.sort(place[start:stop])  # a leaf, in file order, is split as it would be alone
        expected = inside[median_split(position[inside] - summary.origin)]
        assert (place[start:stop] == expected).all()


@pytest.mark.parametrize("kind", ["cloud", "a line", "georeferenced", "some not finite"])
def test_partition__groups_of_leaves_are_as_compact_as_those_of_one_median_split(kind, tmp_path, small):
    position = clouds()[kind]
    place = place_of(through_leaves(ingested(tmp_path / "ingest", position), tmp_path))
    kept = np.sort(place)
    exact = kept[median_split(position[kept])]

    def reach(order: np.ndarray) -> float:
        groups = [position[order[at : at + GROUP]] for at in range(0, len(order) - GROUP, GROUP)]
        return float(np.mean([np.linalg.norm(g - g.mean(axis=0), axis=1).mean() for g in groups]))

    assert reach(place) < 1.02 * reach(exact)


@pytest.mark.parametrize("density", [1.0, 0.6])
def test_partition__order_of_tasks_and_repeats_change_nothing(density, tmp_path, small):
    ingest = ingested(tmp_path / "ingest", clouds()["cloud"])
    once = through_leaves(ingest, tmp_path / "once", density)
    again = through_leaves(ingest, tmp_path / "again", density, lambda n: [*range(n)[::-1], 0, n // 2])
    for name in ("position", "color", "point"):
        assert (arrays.read(once, name) == arrays.read(again, name)).all()
    assert work.summary(once, Points) == work.summary(again, Points)


def test_partition__a_stage_cut_off_between_tasks_goes_on(tmp_path, small):
    ingest = ingested(tmp_path / "ingest", clouds()["cloud"])
    expected = through_leaves(ingest, tmp_path / "whole")
    counts, dealt, folder = tmp_path / "whole/counts", tmp_path / "whole/dealt", tmp_path / "cut"
    stage = Partition(ingest, 1.0, counts, dealt)
    work.begin(folder)
    n = stage.init(folder)
    for index in range(n):
        run_task(stage, folder, index)
        work.sweep(folder)
    work.complete(
        folder, stage.finalise(folder, [work.finished_task(folder, i, OrderedPart).result for i in range(n)]), 0.0
    )
    assert n > 3 and (arrays.read(folder, "point") == arrays.read(expected, "point")).all()
    shutil.rmtree(folder)


def kept_by(density: float, position: np.ndarray, folder: Path) -> tuple[np.ndarray, Points]:
    """Places in the file of the points that are kept, in chunk order, and the summary."""
    ingest = ingested(folder / "ingest", position)
    made = done(Partition(ingest, done(Thin(ingest, density), folder / "thin")), folder / "partition")
    return arrays.read(made, "point"), work.summary(made, Points)


@pytest.mark.parametrize("density", [0.5, 0.1])
def test_partition__density_keeps_that_share_from_everywhere(density, tmp_path):
    position = clouds()["cloud"]
    point, summary = kept_by(density, position, tmp_path)
    assert len(point) == summary.n_splats == pytest.approx(density * len(position), abs=5)
    assert len(np.unique(point)) == len(point)
    assert np.histogram(point, 8, (0, len(position)))[0] == pytest.approx(density * len(position) / 8, rel=0.15)
    np.testing.assert_allclose(arrays.read(tmp_path / "partition", "position"), position[point] - summary.origin)
    assert (place_of(tmp_path / "partition") == point).all()


def test_partition__the_same_points_are_kept_with_leaves_and_without(tmp_path, small):
    ingest = ingested(tmp_path / "ingest", clouds()["some not finite"])
    dealt = through_leaves(ingest, tmp_path, 0.7)
    alone = done(Partition(ingest, tmp_path / "thin"), tmp_path / "alone")
    points = [np.sort(arrays.read(folder, "point")) for folder in (alone, dealt)]
    assert points[0].tolist() == points[1].tolist()
    n = work.summary(ingest, ScanRead).n_points
    assert len(points[0]) == n_kept(ingest, tmp_path / "thin") == pytest.approx(0.7 * n, abs=40)  # of 6 parts


@pytest.mark.parametrize("share", [0.1, 0.25, 0.6])
def test_thinned__leaves_smaller_gaps_than_chance(share):
    rng = np.random.default_rng(0)
    sheet = np.column_stack([rng.random((20_000, 2)), np.zeros(20_000)])
    gap, chance = (KDTree(sheet[keep]).query(sheet)[0] for keep in (thinned(sheet, share), rng.random(20_000) < share))
    assert np.quantile(gap, 0.99) < 0.88 * np.quantile(chance, 0.99)


def test_thinned__of_a_scan_whose_spacing_varies_a_thousandfold_the_density_stays(tmp_path):
    rng = np.random.default_rng(0)
    position = np.concatenate([rng.random((8000, 3)), 1e-3 * rng.random((8000, 3)) + 5])
    keep = thinned(position, 0.1)
    assert np.count_nonzero(keep[:8000]) == pytest.approx(800, abs=3) == np.count_nonzero(keep[8000:])


def test_partition__a_thinner_scan_is_part_of_a_denser_one(tmp_path):
    few, many = (set(kept_by(d, clouds()["cloud"], tmp_path / str(d))[0].tolist()) for d in (0.1, 0.5))
    assert few < many


def test_partition__what_is_kept_tells_nothing_of_what_is_learned_from(tmp_path):
    point, _ = kept_by(0.5, clouds()["cloud"], tmp_path)
    assert (uniform_hash(point, 0) < 0.5).mean() == pytest.approx(0.5, abs=0.02)


def test_partition__a_density_that_keeps_nothing_is_refused(tmp_path):
    stage = Thin(ingested(tmp_path / "ingest", clouds()["all equal"]), 1e-12)
    with pytest.raises(InvalidScan, match="keeps none of 163,917 points; allowed: 6.1e-06 and more"):
        done(stage, tmp_path / stage.name)
