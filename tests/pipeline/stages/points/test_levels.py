"""All levels as the points of one scan: the coarsest first, the finest as it was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.geometry.chunks import median_split
from pipeline.splats.boxes import BLOCK_BOX, boxes_of, store_boxes
from pipeline.splats.coarser import level_sizes
from pipeline.splats.decoded import splat_radii
from pipeline.stages.points.levels import LEVEL_SHIFT, NEIGHBOURS, PARTS, POINTS, SIZES, SLIM, CoarserLevel, Levels
from pipeline.stages.points.sizes import Sizes
from pipeline.summaries import Points, Spacings
from storage.packed.schema import GROUP
from storage.work import arrays, work
from tests.pipeline.stages.points.test_partition import done

N = 17 * GROUP + 300
RADIUS = 0.01


@pytest.fixture(scope="module")
def scan(tmp_path_factory) -> tuple[Path, Path, Path]:
    """Folders as the partition, the neighbours and the sizes leave them, of a wavy surface."""
    folder, rng = tmp_path_factory.mktemp("levels"), np.random.default_rng(0)
    position = rng.uniform(0, 1, (N, 3)) * [1, 1, 0]
    position[:, 2] = 0.05 * np.sin(9 * position[:, 0])
    position = position[median_split(position)]
    columns = {
        "position": position,
        "color": np.rint(255 * position[:, :2] @ [[1, 0, 0.5], [0, 1, 0.5]]).clip(0, 255).astype(np.uint8),
        "point": rng.permutation(N),
        "normal": np.tile(np.float32([0, 0, -2]), (N, 1)),
    }
    points, neighbours = folder / "points", folder / "neighbours"
    for made in (points, neighbours):
        work.begin(made)
    for name, rows in columns.items():
        arrays.store(points, name, rows)
    boxes = [position[at : at + arrays.BLOCK] for at in range(0, N, arrays.BLOCK)]
    store_boxes(points, np.array([b.min(axis=0) for b in boxes]), np.array([b.max(axis=0) for b in boxes]))
    work.complete(points, Points(N, (1, 2, 3), (N,)), 0.0)
    spacing = np.float32(RADIUS * (1 + (position[:, 0] > 0.5)))
    for name, rows in (("spacing", spacing), ("degenerate", rng.random(N) < 0.1)):
        arrays.store(neighbours, name, rows)
    arrays.store(neighbours, "normal", np.tile(np.float32([0, 0, 1]), (N, 1)))
    work.complete(neighbours, Spacings(RADIUS, 5), 0.0)
    return points, neighbours, done(Sizes(points, neighbours, RADIUS), folder / "sizes")


def kept(folder: Path) -> dict:
    return work.read_json(folder / "summary.json")["summary"]


def joined(scan, folder: Path, sized: bool, order=lambda n: range(n)) -> dict[str, Path]:
    points, neighbours, sizes = scan
    coarser: tuple[Path, ...] = ()
    for level in (1, 2):
        source = (coarser[0],) * 2 if coarser else (points, neighbours)
        stage = CoarserLevel(*source, sizes if sized else None, RADIUS, level)
        coarser = (done(stage, folder / f"level-{level}", order), *coarser)
    finest = {POINTS: points, NEIGHBOURS: neighbours, SIZES: sizes if sized else points}
    return {
        part: done(Levels(part, finest[part], coarser, RADIUS, part == SIZES and not sized), folder / part, order)
        for part in PARTS
    }


@pytest.mark.parametrize("sized", [True, False])
def test_levels__the_finest_is_as_it_was_and_coarser_ones_stand_before(scan, sized, tmp_path):
    made = joined(scan, tmp_path, sized)
    counts = level_sizes(N, 2)[::-1]
    assert work.summary(made[POINTS], Points).levels == counts and len(counts) == 3
    total = sum(counts)
    for part, source in zip(PARTS[:2], scan):
        for path in source.glob("*.zarr"):
            if path.stem == BLOCK_BOX:
                continue
            found = arrays.read(made[part], path.stem)
            assert len(found) == total
            np.testing.assert_array_equal(found[-N:], arrays.read(source, path.stem), err_msg=path.stem)
    radii = splat_radii(made[SIZES], RADIUS, 0, total)
    expected = splat_radii(scan[2] if sized else None, RADIUS, 0, N)
    np.testing.assert_allclose(radii[-N:], expected)
    spacing = arrays.read(made[NEIGHBOURS], "spacing")
    for first, stop in ((0, counts[0]), (counts[0], counts[0] + counts[1])):
        assert (radii[first:stop] >= SLIM * spacing[first:stop] * (1 - 1e-6)).mean() > 0.99
    means = [np.mean(part) for part in np.split(radii, np.cumsum(counts)[:-1])]
    assert means[0] / means[1] == pytest.approx(2, rel=0.1) and means[1] / means[2] == pytest.approx(2 * SLIM, rel=0.1)


def test_levels__points_are_named_apart_and_have_what_the_finest_have(scan, tmp_path):
    made = joined(scan, tmp_path, True)
    counts = work.summary(made[POINTS], Points).levels
    point = arrays.read(made[POINTS], "point")
    assert len(np.unique(point)) == len(point)
    assert (point >> LEVEL_SHIFT == np.repeat([2, 1, 0], counts)).all()
    position, color = arrays.read(made[POINTS], "position"), arrays.read(made[POINTS], "color").astype(float)
    assert np.abs(color[:, 0] - 255 * position[:, 0]).max() < 20  # a mean of neighbours, not of anyone
    normal = arrays.read(made[POINTS], "normal")
    assert (normal[:, 2] < 0).all() and np.allclose(np.linalg.norm(normal[: -counts[2]], axis=1), 1, atol=1e-6)


def test_levels__blocks_have_the_boxes_of_their_points(scan, tmp_path):
    made = joined(scan, tmp_path, True)[POINTS]
    summary = work.summary(made, Points)
    for i in range(arrays.n_blocks(summary.n_splats)):
        block = arrays.read(made, "position", *arrays.block_range(i, summary.n_splats))
        np.testing.assert_array_equal(boxes_of(made)[0][i], block.min(axis=0))
        np.testing.assert_array_equal(boxes_of(made)[1][i], block.max(axis=0))


def test_levels__order_of_tasks_and_repeats_change_nothing(scan, tmp_path):
    once = joined(scan, tmp_path / "once", True)
    again = joined(scan, tmp_path / "again", True, lambda n: [*range(n)[::-1], n // 2])
    for part in PARTS:
        assert kept(once[part]) == kept(again[part])
        for path in once[part].glob("*.zarr"):
            found = [arrays.read(made[part], path.stem) for made in (once, again)]
            np.testing.assert_array_equal(*found, err_msg=path.stem)
