"""Points by slices: the same arrays, whoever reads them in which order, and from the start of the file alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.execution.stage import run_stage
from pipeline.execution.task import run_task
from pipeline.readers import open_scan
from pipeline.readers.ply import ply
from pipeline.stages.points import ingest
from pipeline.stages.points.ingest import Ingest, slice_rows
from pipeline.summaries import ScanRead
from storage.errors import InvalidScan
from storage.work import arrays
from tests.pipeline.readers import test_las, test_ply
from tests.pipeline.readers.workspace import write_workspace, zip_folder

FIELDS = [(name, "f4") for name in ("x", "y", "z", "red", "green", "blue", "intensity")]


class Quiet:
    def begin(self, *_): ...

    def advance(self, *_): ...

    def end(self, *_): ...


class Backwards:
    """The last task first, and every task twice."""

    n_workers = 1

    def run(self, stage, folder, indices, on_done):
        for index in reversed(indices):
            run_task(stage, folder, index)
            on_done(index, run_task(stage, folder, index))

    def call(self, name, function, *arguments):
        return function(*arguments)


def table(n: int) -> np.ndarray:
    rows = np.zeros(n, FIELDS)
    rng = np.random.default_rng(0)
    for name, _ in FIELDS:
        rows[name] = rng.uniform(0, 1, n).astype(np.float32)
    rows["x"][rng.random(n) < 0.2] = np.nan
    rows["x"][100:200] = np.nan  # a slice of none
    rows["red"][::9] = np.nan
    rows["intensity"][::7] = np.nan
    return rows


def made(scan: Path, folder: Path) -> tuple[Path, dict]:
    record = run_stage(Ingest(str(scan), "any"), folder, Backwards(), Quiet())
    return record.folder, record.summary


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(ingest, "SLICE", 50)
    monkeypatch.setattr(ingest, "PIECE", 17)
    monkeypatch.setattr(ingest, "LEAST_SAMPLE", 5)
    monkeypatch.setattr(ingest, "SAMPLE", 8)
    ingest._opened.cache_clear()


def assert_same(one: tuple[Path, ScanRead], other: tuple[Path, ScanRead]) -> None:
    assert replace(one[1], warnings=()) == replace(other[1], warnings=())
    names = [path.stem for path in sorted(one[0].glob("*.zarr"))]
    assert names == [path.stem for path in sorted(other[0].glob("*.zarr"))]
    for name in names:
        np.testing.assert_array_equal(arrays.opened(one[0], name)[:], arrays.opened(other[0], name)[:], err_msg=name)


def test_ingest__warnings_call_a_scan_by_its_name_and_not_by_its_folder(tmp_path):
    path, _ = test_las.write(tmp_path / "Scan Ü.las")
    warnings = made(path, tmp_path / "work")[1].warnings
    assert any(text.startswith("Scan Ü.las: ") for text in warnings) and not any(str(tmp_path) in w for w in warnings)


def test_ingest__slices_are_what_one_reading_from_the_start_gives(tmp_path, small):
    rows = table(1003)
    binary, text = test_ply.write(tmp_path / "b.ply", rows), test_ply.write(tmp_path / "a.ply", rows, "ascii")
    assert open_scan(binary).read_slice and not open_scan(text).read_slice
    found = [made(path, tmp_path / path.stem) for path in (binary, text)]
    assert_same(*found)
    summary = found[0][1]
    assert summary.n_read == 1003 and summary.n_dropped == np.isnan(rows["x"]).sum()
    position = arrays.read(found[0][0], "position")
    kinds = [arrays.layout_of(folder, "position").dtype for folder, _ in found]
    assert kinds == [np.float32, np.float64], "of a file that has coordinates as float32 they are kept so"
    np.testing.assert_array_equal(np.isnan(position).any(axis=1), np.isnan(rows["x"]))
    np.testing.assert_array_equal(summary.low, np.nanmin(position, axis=0))
    assert any(f"{(np.isnan(rows['red']) & ~np.isnan(rows['x'])).sum()} of" in w for w in summary.warnings)


@pytest.mark.parametrize("n_sampled", [1 << 14, 40])
def test_ingest__a_workspace_and_its_archive_are_the_same(tmp_path, small, monkeypatch, n_sampled):
    """An archive is read from its start, so its pieces are cut where slices end; what was seen of a piece is not."""
    monkeypatch.setattr(ply, "_FIRST_POINTS", n_sampled)
    folder = write_workspace(tmp_path / "w").path
    assert_same(made(folder, tmp_path / "1"), made(zip_folder(folder, tmp_path / "w.zip"), tmp_path / "2"))


def test_ingest__the_sample_is_of_points_from_every_slice(tmp_path, small):
    rows = table(1003)
    folder, _ = made(test_ply.write(tmp_path / "a.ply", rows), tmp_path)
    sample, position = arrays.read(folder, "sample"), arrays.read(folder, "position")
    for i, chosen in enumerate(sample.reshape(-1, 5, 3)):
        there = position[50 * i : 50 * i + 50]
        there = there[np.isfinite(there).all(axis=1)]
        chosen = chosen[np.isfinite(chosen).all(axis=1)]
        assert len(chosen) == min(5, len(there)) == len(np.unique(chosen, axis=0))
        assert {tuple(p) for p in chosen} <= {tuple(p) for p in there}


@pytest.mark.parametrize(
    ("n", "decoded_at_once", "expected"),
    [(1000, 1, 1 << 18), (10**8, 1, 1 << 18), (10**10, 1, 1_220_704), (10**8, 50_000, 250_000), (10**8, 10**6, 10**6)],
)
def test_ingest__slices_are_whole_runs_of_what_is_decoded_at_once(n, decoded_at_once, expected):
    class Source:
        n_points, slice_rows = n, decoded_at_once

    assert slice_rows(Source()) == expected


def test_ingest__a_scan_without_any_finite_point_is_refused(tmp_path, small):
    rows = table(300)
    rows["y"] = np.inf
    with pytest.raises(InvalidScan, match="none of its 300 points is left: 300 have a position that is not finite"):
        made(test_ply.write(tmp_path / "a.ply", rows), tmp_path)
