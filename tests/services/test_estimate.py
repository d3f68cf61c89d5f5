"""Estimates: real stages on a sample, scaled, and set against what then happens."""

from __future__ import annotations

import json

import numpy as np
import pytest

from pipeline.executors import SerialExecutor
from pipeline.settings import settings_for
from pipeline.stages.sampled import CELL, SampledPartition
from services import estimate as module
from services.cli import main
from services.estimate import estimate
from services.kept_estimates import against, known_estimate
from services.workflow import Run, compress, points_of
from storage import arrays
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
