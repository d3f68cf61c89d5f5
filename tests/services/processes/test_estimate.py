"""Estimates: real stages on a sample, scaled, and set against what then happens."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from msgspec import to_builtins

from pipeline.execution.executors import SerialExecutor
from pipeline.execution.stage import StageRecord
from pipeline.planning.settings import settings_for
from pipeline.stages.points.sampled import Sampled
from pipeline.summaries import Counted, Points
from renderer.evaluate.close_ups import Variant
from renderer.evaluate.picture_psnr import picture_psnrs
from services.cli.main import main
from services.flow.asked import prepare_asked
from services.flow.estimate_cache import against, known_estimate
from services.flow.prepare import splats_of
from services.flow.run import Run
from services.processes import estimate as module
from services.processes.compress import compress
from services.processes.estimate import estimate
from storage.packed.schema import CHUNK
from storage.work import arrays, work
from tests.pipeline.execution.test_stage import Heard
from tests.services.processes.published_schemas import misfits
from tests.services.scans import photo_scan, point_scan

SAMPLE = 24 * CHUNK
SETTINGS = settings_for(
    "draft", dictionary="own", target_psnr_db=30.0, training_splats=4000, iterations=2, effects="pages=on"
)


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    return photo_scan(tmp_path_factory.mktemp("scan") / "wavy plane", n_side=100)


@pytest.fixture(scope="module")
def estimated(scan, tmp_path_factory):
    """An estimate from a third of the splats, and the report of the job that followed."""
    work, out = tmp_path_factory.mktemp("work"), tmp_path_factory.mktemp("out") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "SAMPLE", SAMPLE)
        found = to_builtins(estimate(scan, SETTINGS, SerialExecutor(), Heard(), work))
    return found, compress(scan, out, SETTINGS, SerialExecutor(), Heard(), render=False, work=work), work, out


def test_estimate__pictures_are_near_those_of_the_job(estimated, scan, renderer):
    found, _, folder, out = estimated
    prepared = prepare_asked(Run(folder, SerialExecutor(), Heard()), scan, SETTINGS)
    [happened] = picture_psnrs([Variant("job", next(out.glob("*.splatpress")))], prepared.photos)
    assert found["picture_psnr_db"]["value"] == pytest.approx(happened, abs=0.5)


def test_estimate__bytes_and_psnr_are_near_what_happens(estimated):
    found, report, _, _ = estimated
    assert found["sample"]["n_splats"] == SAMPLE and found["splats"] == 10_000
    assert found["gpu_bytes"]["value"] == pytest.approx(report["sizes"]["gpu_bytes"], rel=0.05)
    assert found["file_bytes"]["value"] == pytest.approx(report["sizes"]["file_bytes"], rel=0.05)
    assert found["texture_psnr_db"]["value"] == pytest.approx(report["quality"]["texture_psnr_db"], abs=0.5)
    assert found["pages_bytes"]["value"] == pytest.approx(report["pages"]["bytes"], rel=0.15), (
        "from two of three photographs"
    )
    for part in ("geometry_bytes", "colors_bytes", "dictionary_bytes"):
        assert found["sizes"][part] == pytest.approx(report["sizes"][part], rel=0.02)


def test_estimate__the_report_sets_it_beside_what_happened(estimated):
    found, report, work, out = estimated
    assert to_builtins(known_estimate(work, SETTINGS)) == found
    (out / "estimate.json").write_text(json.dumps(found))
    assert misfits(out / "estimate.json") == []
    beside = report["estimate"]
    assert set(beside) == {
        "seconds",
        "peak_memory_bytes",
        "gpu_bytes",
        "file_bytes",
        "texture_psnr_db",
        "pages_bytes",
    }
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
    assert seconds["encode"] > pilot["encode"] and seconds["splats"] == pilot["splats"]


def test_estimate__leaves_only_what_the_job_uses_again(estimated):
    _, report, work, _ = estimated
    reused = {s["name"] for s in report["stages"] if s["reused"]}
    assert reused >= {"ingest", "partition", "neighbours", "splats", "measure-effects"} and "resample" not in reused
    assert not [p for p in work.iterdir() if p.name.startswith((".estimate", "sampled"))]


def test_estimate__other_settings_have_none(estimated):
    assert known_estimate(estimated[2], settings_for("balanced")) is None and against(None, {}) is None


def test_estimate__points_without_photographs_have_bytes_and_no_psnr(tmp_path, capsys):
    scan = point_scan(tmp_path / "ball.ply")
    assert main(["estimate", str(scan), "--executor", "serial", "--json"]) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["texture_psnr_db"] is None and found["bytes_per_splat"] == pytest.approx(8.2, abs=0.3)
    assert main(["estimate", str(scan), "--executor", "serial", "--target-psnr-db", "42"]) == 0
    said = capsys.readouterr().out
    assert (
        "--target-psnr-db 42 is not used" in said
        and "Bytes on the GPU" in said
        and [p.name for p in tmp_path.iterdir()] == ["ball.ply"]
    )


@pytest.mark.parametrize("n_wanted", [3 * CHUNK, 10**9, 100])
def test_sampled__takes_whole_chunks_from_everywhere(scan, tmp_path, n_wanted):
    prepared = splats_of(Run(tmp_path / "work", SerialExecutor(), Heard()), scan, None)
    splats, partition = prepared.splats.folder, prepared.partition.folder
    sample = Run(tmp_path / "work", SerialExecutor(), Heard()).do(Sampled(splats, partition, n_wanted))
    n = sample.summary.n_splats
    assert n == {3 * CHUNK: 3 * CHUNK, 10**9: 10_000, 100: CHUNK}[n_wanted]
    points = Run(tmp_path / "work", SerialExecutor(), Heard()).do(Sampled(partition, partition, n_wanted)).summary
    assert points == replace(work.summary(partition, Points), n_splats=n, levels=(n,))
    whole, taken = (
        np.concatenate([arrays.read(f, "position_code")[:, None], arrays.read(f, "normal_code")], axis=1)
        for f in (splats, sample.folder)
    )
    boxes, chosen = (arrays.read(f, "box_low") for f in (splats, sample.folder))
    chunks = [int(np.flatnonzero((boxes == box).all(axis=1))[0]) for box in chosen]
    assert (taken == np.concatenate([whole[c * CHUNK : (c + 1) * CHUNK] for c in chunks])).all()
    assert len(set(chunks)) == len(chunks) and np.diff([-1, *chunks, len(boxes)]).max() <= 2 * max(
        1, len(boxes) // len(chunks)
    )


# --- scaling, on stages that were never run


@dataclass(frozen=True)
class OfSplats:
    splats: Path
    name = "of-splats"


@dataclass(frozen=True)
class FirstOfSplats:
    splats: Path
    name = "resample"


@dataclass(frozen=True)
class OfPatches:
    training: Path
    name = "quantise"


def seconds_of(
    stage, folder: Path, tasks: list[tuple[float, int]], made: float, n_workers: int = 2, compiling: float = 0.0
) -> float:
    """Of a scan of 2,000 splats by a pilot of 200, and of 900 training patches by 300."""
    work.begin(folder)
    for i, (seconds, n) in enumerate(tasks):
        work.record_task(folder, i, work.TaskRecord(None, n, seconds, seconds / 2, compiling, 0))
    record = StageRecord(stage.name, folder, {}, made, 0, len(tasks), sum(n for _, n in tasks), False, made)
    prepared = SimpleNamespace(splats=SimpleNamespace(summary=Counted(2000)))
    pilot = module._Pilot(prepared, None, SETTINGS, {}, 0, 0, 200, [], [], n_workers)
    learning = {"n_patches": 900, "n_patches_pilot": 300, "n_atoms": 16, "n_atoms_pilot": 16}
    seconds, processor_seconds = module._stage_seconds(pilot, stage, record, SETTINGS, learning)
    busy = processor_seconds * 2  # what both clocks counted of the tasks
    assert seconds >= busy / n_workers - 1e-9
    return seconds


def test_scaling__tasks_of_splats_grow_with_the_scan(tmp_path):
    """20 tasks of 0.75 s on two workers, and the 0.25 s that the stage took beside its tasks."""
    assert seconds_of(OfSplats(Path("s")), tmp_path, [(1.0, 100), (0.5, 100)], 1.0) == pytest.approx(
        20 * 0.75 / 2 + 0.25
    )


def test_scaling__the_first_stage_grows_at_the_rate_of_its_warm_task(tmp_path):
    """20 tasks of 0.5 s: the other met a worker without pages of memory."""
    assert seconds_of(FirstOfSplats(Path("s")), tmp_path, [(1.0, 100), (0.5, 100)], 1.0) == pytest.approx(
        20 * 0.5 / 2 + 0.25
    )


def test_scaling__kernels_are_compiled_once(tmp_path):
    """20 tasks of 0.5 s on two workers: half of each of the pilot's went into compiling."""
    assert seconds_of(OfSplats(Path("s")), tmp_path, [(1.0, 100), (1.0, 100)], 1.0, compiling=0.5) == pytest.approx(
        20 * 0.5 / 2
    )


def test_scaling__a_last_round_leaves_workers_idle(tmp_path):
    assert seconds_of(OfSplats(Path("s")), tmp_path, [(1.0, 200)], 1.0, n_workers=3) == pytest.approx(
        4.0
    )  # 10 tasks of 1 s


def test_scaling__a_stage_of_training_patches_grows_with_them(tmp_path):
    assert seconds_of(OfPatches(Path("t")), tmp_path, [(1.0, 150), (1.0, 150)], 1.0) == pytest.approx(3.0)


def test_estimate__passes_as_coded_and_with_exact_weights_are_scaled_each_by_themselves():
    job = settings_for("balanced", iterations=14)
    pilot = SimpleNamespace(settings=settings_for("balanced", iterations=4), coded=SimpleNamespace(learning=(1, 2)))
    assert module._passes(pilot, job, 60_000, as_coded=False) == (8 / 2, 10_000 / 60_000)
    assert module._passes(pilot, job, 60_000, as_coded=True) == (6 / 2, 1.0)
    ended = SimpleNamespace(settings=pilot.settings, coded=SimpleNamespace(learning=(1,)))
    assert module._passes(ended, job, 60_000, as_coded=False)[0] == 1.0  # as the job's will
    paper = replace(job, coder="paper")
    assert module._passes(SimpleNamespace(settings=paper, coded=ended.coded), paper, 60_000, as_coded=False) == (
        1.0,
        1.0,
    )
