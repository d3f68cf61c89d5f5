"""Estimates: real stages on a sample, scaled, and set against what then happens."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.executors import SerialExecutor
from pipeline.settings import settings_for
from pipeline.stage import StageRecord
from pipeline.stages.sampled import CELL, SampledPartition
from services import estimate as module
from services.cli import main
from services.estimate import estimate
from services.kept_estimates import against, known_estimate
from services.workflow import Run, compress, points_of
from storage import arrays, work
from tests.pipeline.test_stage import Heard
from tests.services.scans import photo_scan, point_scan

SETTINGS = settings_for("draft", target_psnr_db=30.0, training_splats=4000, iterations=2)


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    return photo_scan(tmp_path_factory.mktemp("scan") / "wavy plane", n_side=100)


@pytest.fixture(scope="module")
def estimated(scan, tmp_path_factory):
    """An estimate from a third of the splats, and the report of the job that followed."""
    work, out = tmp_path_factory.mktemp("work"), tmp_path_factory.mktemp("out") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "SAMPLE", 6 * CELL)
        found = estimate(scan, SETTINGS, SerialExecutor(), Heard(), work)
    return found, compress(scan, out, SETTINGS, SerialExecutor(), Heard(), render=False, work=work), work, out


def test_estimate__bytes_and_psnr_are_near_what_happens(estimated):
    found, report, _, _ = estimated
    assert found["sample"]["n_splats"] == 6 * CELL and found["splats"] == 10_000
    assert found["gpu_bytes"]["value"] == pytest.approx(report["sizes"]["gpu_bytes"], rel=0.05)
    assert found["texture_psnr_db"]["value"] == pytest.approx(report["quality"]["texture_psnr_db"], abs=0.5)
    for part in ("geometry_bytes", "colors_bytes", "dictionary_bytes"):
        assert found["sizes"][part] == pytest.approx(report["sizes"][part], rel=0.02)


def test_estimate__the_report_sets_it_beside_what_happened(estimated):
    found, report, work, out = estimated
    assert known_estimate(work, SETTINGS) == json.loads(json.dumps(found))
    beside = report["estimate"]
    assert set(beside) == {"seconds", "peak_memory_bytes", "gpu_bytes", "texture_psnr_db"}
    assert beside["gpu_bytes"]["happened"] == report["sizes"]["gpu_bytes"]
    assert beside["texture_psnr_db"]["happened"] == report["quality"]["texture_psnr_db"]
    assert beside["seconds"]["happened"] >= sum(s["seconds"] for s in report["stages"] if not s["reused"])
    assert "Estimated, and what happened" in (out / "report.html").read_text()


def test_estimate__every_stage_of_the_job_has_its_seconds(estimated):
    found, report, _, _ = estimated
    seconds = {row["name"]: row["seconds"] for row in found["stages"]}
    assert seconds.keys() >= {s["name"] for s in report["stages"]} and all(s >= 0 for s in seconds.values())
    assert found["seconds"]["value"] == pytest.approx(sum(seconds.values()))
    pilot = {row["name"]: row["pilot_seconds"] for row in found["stages"]}
    assert seconds["resample"] > pilot["resample"] and seconds["partition"] == pilot["partition"]


def test_estimate__leaves_only_what_the_job_uses_again(estimated):
    _, report, work, _ = estimated
    assert {s["name"]: s["reused"] for s in report["stages"]}["partition"]
    assert not [p for p in work.iterdir() if p.name.startswith((".estimate", "sampled"))]


def test_estimate__other_settings_have_none(estimated):
    assert known_estimate(estimated[2], settings_for("balanced")) is None and against(None, {}) is None


def test_estimate__points_without_photographs_have_bytes_and_no_psnr(tmp_path, capsys):
    scan = point_scan(tmp_path / "ball.ply")
    assert main(["estimate", str(scan), "--executor", "serial", "--json"]) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["texture_psnr_db"] is None and found["bytes_per_splat"] == pytest.approx(8.2, abs=0.3)
    assert main(["estimate", str(scan), "--executor", "serial"]) == 0
    assert "Bytes on the GPU" in capsys.readouterr().out and [p.name for p in tmp_path.iterdir()] == ["ball.ply"]


@pytest.mark.parametrize("n_wanted", [3 * CELL, 10**9, 100])
def test_sampled_partition__takes_whole_cells_from_everywhere(scan, tmp_path, n_wanted):
    run = Run(tmp_path / "work", SerialExecutor(), Heard())
    _, partition = points_of(run, scan)
    sample = run.do(SampledPartition(partition.folder, n_wanted))
    whole, taken = (arrays.read(r.folder, "position") for r in (partition, sample))
    at = {tuple(p): i for i, p in enumerate(whole)}
    rows = np.array([at[tuple(p)] for p in taken])
    assert len(set(rows)) == len(rows) == sample.summary["n_splats"] == min(n_wanted, 10_000 // CELL * CELL)
    if n_wanted >= CELL:
        assert (np.diff(rows.reshape(-1, CELL)) == 1).all()
        assert np.diff(np.sort(rows[::CELL])).max() <= 2 * len(whole) * CELL // len(rows)
    assert (taken.min(axis=0) >= np.min(sample.summary["block_low"], axis=0)).all()


# --- scaling, on stages that were never run


@dataclass(frozen=True)
class OfSplats:
    splats: Path
    name = "of-splats"


@dataclass(frozen=True)
class OfSomeSplats:
    splats: Path
    name = "of-some"
    most_splats = 400


@dataclass(frozen=True)
class OfPhotographs:
    ingest: Path
    name = "of-photographs"


@dataclass(frozen=True)
class OfPatches:
    training: Path
    name = "quantise"


def seconds_of(stage, folder: Path, tasks: list[tuple[float, int]], made: float, n_workers: int = 2) -> float:
    """Of a scan of 2,000 splats by a pilot of 200, and of 900 training patches by 300."""
    work.begin(folder)
    for i, (seconds, n) in enumerate(tasks):
        work.record_task(folder, i, {"seconds": seconds, **({"n_splats": n} if n else {})})
    record = StageRecord(stage.name, folder, {}, made, 0, len(tasks), sum(n for _, n in tasks), False, made)
    ingest = StageRecord("ingest", Path("ingest"), {}, 0, 0, 1, 0, False)
    prepared = SimpleNamespace(scan=SimpleNamespace(summary={"n_points": 2000}), splats=SimpleNamespace(summary={"n_splats": 200}))
    pilot = module._Pilot(prepared, None, SETTINGS, {}, [], [ingest], n_workers)
    learning = {"n_patches": 900, "n_patches_pilot": 300, "n_atoms": 16, "n_atoms_pilot": 16}
    return module._stage_seconds(pilot, stage, record, SETTINGS, learning)


def test_scaling__tasks_of_splats_grow_with_the_scan_at_the_warm_rate(tmp_path):
    """20 tasks of 0.5 s on two workers, and the 0.25 s that the stage took beside its tasks."""
    assert seconds_of(OfSplats(Path("s")), tmp_path, [(1.0, 100), (0.5, 100)], 1.0) == pytest.approx(20 * 0.5 / 2 + 0.25)


def test_scaling__a_last_round_leaves_workers_idle(tmp_path):
    assert seconds_of(OfSplats(Path("s")), tmp_path, [(1.0, 200)], 1.0, n_workers=3) == pytest.approx(4.0)  # 10 tasks of 1 s


def test_scaling__a_stage_that_looks_at_some_splats_grows_to_as_many(tmp_path):
    assert seconds_of(OfSomeSplats(Path("s")), tmp_path, [(1.0, 100), (1.0, 100)], 1.0) == pytest.approx(2.0)


def test_scaling__a_stage_of_photographs_does_not_grow(tmp_path):
    assert seconds_of(OfPhotographs(Path("ingest")), tmp_path, [(1.0, 0), (1.0, 0)], 1.5) == 1.5


def test_scaling__a_stage_of_training_patches_grows_with_them(tmp_path):
    assert seconds_of(OfPatches(Path("t")), tmp_path, [(1.0, 150), (1.0, 150)], 1.0) == pytest.approx(3.0)
