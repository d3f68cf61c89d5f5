"""From a scan or volume to a packed file of runs: every point's cell is there, the same bytes whatever runs the tasks,
and what is reported."""

from __future__ import annotations

import ast
import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pipeline.execution.executors import SerialExecutor
from pipeline.geometry.hcp import centres_of, keys_of
from pipeline.geometry.normals import decode_normals
from pipeline.geometry.runs import bricks
from pipeline.planning.settings import settings_for
from pipeline.splats.decoded import scene_normal_codes, scene_positions
from services.cli.main import main
from services.processes.compress import compress
from services.processes.estimate import estimate
from storage.errors import SplatpressError
from storage.packed.packed import PackedFile
from tests.hard_cases.scans import write_points
from tests.pipeline.execution.test_stage import Heard
from tests.pipeline.geometry.runs.test_cells import sphere
from tests.pipeline.volumes.made import ball, middle_of, write_nrrd


class Backwards(SerialExecutor):
    """Every stage's last task first."""

    def run(self, stage, folder, indices, on_done):
        super().run(stage, folder, indices[::-1], on_done)


def compressed(scan: Path, out: Path, executor=None, **settings):
    told = compress(scan, out, settings_for("draft", **settings), executor or SerialExecutor(), Heard(), render=False)
    with PackedFile(next(out.glob("*.splatpress"))) as packed:
        return told, packed.load()


@pytest.fixture(scope="module")
def ball_of_points(tmp_path_factory) -> tuple[Path, np.ndarray, np.ndarray]:
    unit = sphere(8_000)
    position = 2 * unit + [1000.0, -50.0, 3.0]
    color = np.where(unit[:, :1] > 0, [[255, 0, 0]], [[0, 0, 255]]).astype(np.uint8)
    path = tmp_path_factory.mktemp("scan") / "ball.ply"
    write_points(path, position, unit.astype(np.float32), color)
    return path, position, unit


@pytest.fixture(scope="module")
def out(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("runs") / "out"


@pytest.fixture(scope="module")
def of_runs(ball_of_points, out):
    return compressed(ball_of_points[0], out, geometry="runs")


def test_runs__hold_the_cell_of_every_point_and_their_normals_and_colours(ball_of_points, of_runs):
    _, position, unit = ball_of_points
    told, scene = of_runs
    grid, centre = scene.header.runs, scene_positions(scene)
    turn = np.array(grid.turn).reshape(3, 3)
    keys = keys_of((position - scene.header.origin) @ turn, grid.cell)
    where = np.unique(np.round(centres_of(np.unique(keys), grid.cell) / grid.cell, 3), axis=0)
    found = np.unique(np.round(centre @ turn / grid.cell, 3), axis=0)
    assert len(where) == told["runs"]["cells"] and len(found) == len(where) + told["runs"]["added"]
    assert set(map(tuple, where)) <= set(map(tuple, found))
    outwards = (centre + scene.header.origin - [1000.0, -50.0, 3.0]) / 2
    cosine = (decode_normals(scene_normal_codes(scene)) * outwards).sum(axis=1) / np.linalg.norm(outwards, axis=1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 6
    far = np.abs(outwards[:, 0]) > 0.05
    assert ((scene.arrays["color"][far, 0] > 128) == (outwards[far, 0] > 0)).all()


def test_runs__report_what_they_lose_and_cost(of_runs):
    runs = of_runs[0]["runs"]
    assert 1 < runs["hit_rate"] <= 1.6 and 0 < runs["efficiency"] <= 1 and runs["twice"] <= 0.02
    assert runs["mean_error"] < runs["max_error"] <= runs["cell"] * math.sqrt(0.5) * (1 + 1e-9)
    assert set(runs["bits"]) == {"start", "steps", "normals"}
    sizes, n = of_runs[0]["sizes"]["arrays"], of_runs[1].header.n_splats
    counted = sum(8 * size for name, size in sizes.items() if name.startswith("run_")) / n
    assert sum(runs["bits"].values()) == pytest.approx(counted, rel=0.01)


def test_runs__are_estimated_with_their_stages(ball_of_points, of_runs):
    told, _ = of_runs
    found = estimate(ball_of_points[0], settings_for("draft", geometry="runs"), SerialExecutor(), Heard())
    assert {"run-grid", "run-cells", "runs", "run-points"} <= {row.name for row in found.stages}
    assert found.gpu_bytes.value == pytest.approx(told["sizes"]["gpu_bytes"], rel=0.05)
    assert found.file_bytes.value == pytest.approx(told["sizes"]["file_bytes"], rel=0.05)


def test_runs__become_a_page_too(of_runs, out, capsys):
    page = out / "ball.html"
    assert main(["export", str(out / "ball.splatpress"), "--to", "html", "--out", str(page)]) == 0
    assert page.stat().st_size <= 1.37 * (out / "ball.splatpress").stat().st_size + 60_000


def test_runs__are_the_same_bytes_for_any_order_of_tasks_and_bricks_hold_all(ball_of_points, tmp_path, monkeypatch):
    monkeypatch.setattr(bricks.split, "__defaults__", (1_000,))
    made = []
    for name, executor in (("a", SerialExecutor()), ("b", Backwards())):
        told, scene = compressed(ball_of_points[0], tmp_path / name, executor, geometry="runs", cell=0.1)
        made.append((tmp_path / name / "ball.splatpress").read_bytes())
    assert made[0] == made[1]
    _, position, _ = ball_of_points
    keys = keys_of((position - scene.header.origin) @ np.array(scene.header.runs.turn).reshape(3, 3), 0.1)
    assert told["runs"]["cells"] == len(np.unique(keys)) and told["runs"]["cell"] == 0.1
    assert told["runs"]["points"] == len(position)


class Killed(SerialExecutor):
    """Its process is killed once a task of a stage has written what it makes, and told nobody."""

    def __init__(self, stage: str):
        super().__init__()
        self.stage = stage

    def run(self, stage, folder, indices, on_done):
        if stage.name == self.stage:
            stage.run(folder, indices[-1])
            os.kill(os.getpid(), signal.SIGKILL)
        super().run(stage, folder, indices, on_done)


def test_runs__of_a_volume_are_the_same_bytes_though_each_stage_is_killed_once(tmp_path, monkeypatch):
    monkeypatch.setattr(bricks.split, "__defaults__", (1_000,))
    volume = write_nrrd(tmp_path / "ball.nrrd", ball((24, 22, 20)).astype(np.float32))
    settings = settings_for("draft", geometry="runs")
    told, _ = compressed(volume, tmp_path / "whole", geometry="runs")
    stages = ("voxels", "iso-values", "iso-surface", "run-grid", "run-cells", "runs", "run-points")
    assert set(stages) <= {stage["name"] for stage in told["stages"]}
    for stage in stages:
        process = os.fork()
        if not process:
            try:
                compress(
                    volume, tmp_path / "no", settings, Killed(stage), Heard(), render=False, work=tmp_path / "work"
                )
            finally:
                os._exit(1)
        assert os.WTERMSIG(os.waitpid(process, 0)[1]) == signal.SIGKILL
    compress(volume, tmp_path / "again", settings, SerialExecutor(), Heard(), render=False, work=tmp_path / "work")
    assert (tmp_path / "again/ball.splatpress").read_bytes() == (tmp_path / "whole/ball.splatpress").read_bytes()


def test_runs__nothing_of_them_is_loaded_for_a_scan_in_boxes(tmp_path):
    write_points(tmp_path / "ball.ply", sphere(300))
    program = (
        "import sys; from services.cli.main import main; assert not main(sys.argv[1:]); "
        "print([m for m in sys.modules if 'geometry.runs' in m or 'stages.runs' in m or 'upload.runs' in m])"
    )
    asked = ["compress", "ball.ply", "--preset", "draft", "--executor", "serial", "--no-render", "--out", "out"]
    paths = os.environ | {"PYTHONPATH": str(Path(__file__).parents[3])}
    done = subprocess.run(
        [sys.executable, "-c", program, *asked], cwd=tmp_path, env=paths, capture_output=True, text=True, check=True
    )
    loaded = ast.literal_eval(done.stdout.splitlines()[-1])
    assert {m.removeprefix("pipeline.") for m in loaded} <= {  # types alone
        "geometry.runs", "geometry.runs.frame", "stages.runs", "stages.runs.found"
    }  # fmt: skip


def test_runs__auto_takes_what_is_smaller_at_the_asked_error(ball_of_points, tmp_path):
    bare = write_points(tmp_path / "bare.ply", ball_of_points[1][::8])
    told, scene = compressed(bare, tmp_path / "coarse", geometry="auto", cell=0.3)
    row, page = told["effects"][0], (tmp_path / "coarse" / "report.html").read_text()
    assert scene.header.runs and row["effect"] == "geometry_runs" and row["enabled"] and row["measure"] < 1
    assert any("normals that were estimated" in warning for warning in told["warnings"])
    assert "cells of 0.3 units" in page and "Where runs of cells begin" in page and "Positions (24 bits)" not in page
    told, scene = compressed(ball_of_points[0], tmp_path / "fine", geometry="auto", cell=0.0001)
    assert scene.header.runs is None and not told["effects"][0]["enabled"] and told["effects"][0]["measure"] >= 1
    told, scene = compressed(bare, tmp_path / "none", geometry="boxes", cell=0.3)
    assert "cell 0.3 is not used: boxes of a scan have no cells" in told["warnings"]
    assert scene.header.runs is None and told["runs"] is None and told["effects"][0]["effect"] != "geometry_runs"


def test_runs__of_a_volume_are_the_cells_of_its_own_grid(tmp_path):
    shape, spacing = (30, 28, 40), (0.5, 0.5, 0.4)
    directions = "space directions: (-0.5,0,0) (0,0.4,0.3) (0,-0.24,0.32)\nspace origin: (100,-20,7)\n"
    head = "space: left-posterior-superior\n" + directions
    volume = write_nrrd(tmp_path / "ball.nrrd", ball(shape, spacing, radius=5.0).astype(np.float32), "raw", head)
    told, scene = compressed(volume, tmp_path / "out", geometry="runs", iso="20,50")
    index = middle_of(shape, spacing) / spacing
    middle = [100, -20, 7] + index @ np.array([[-0.5, 0, 0], [0, 0.4, 0.3], [0, -0.24, 0.32]])
    radius = np.linalg.norm(scene_positions(scene) + scene.header.origin - middle, axis=1)
    off = np.minimum(np.abs(radius - 5), np.abs(radius - 8))
    assert off.max() < told["runs"]["cell"] and off.mean() < 0.4 * told["runs"]["cell"]
    assert told["runs"]["max_error"] < 1e-6 and told["runs"]["efficiency"] > 0.5
    assert len(np.unique(scene.arrays["color"], axis=0)) == 2


def test_runs__of_all_points_in_one_place_or_too_many_cells_say_so(tmp_path, ball_of_points):
    write_points(tmp_path / "one.ply", np.ones((50, 3)), np.tile([0.0, 0, 1], (50, 1)), None)
    told, scene = compressed(
        tmp_path / "one.ply", tmp_path / "one", geometry="runs", radius=1.0, levels=2, effects="ellipsoids=off"
    )
    assert "levels 2 is not used: runs have no coarser levels" in told["warnings"]
    reasons = {row["effect"]: row["reason"] for row in told["effects"]}
    assert (reasons["ellipsoids"], reasons["levels"]) == ("asked to be off", "runs have no coarser levels")
    assert told["runs"]["cells"] == 1 and scene.header.n_splats == 1
    with pytest.raises(SplatpressError, match="cells along an axis"):
        compressed(ball_of_points[0], tmp_path / "fine", geometry="runs", cell=1e-7)
