"""Close-ups of edges: drawn where cliplines matter, with them, without them, and as photographed."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.execution.executors import SerialExecutor
from pipeline.planning.settings import settings_for
from pipeline.readers.photos import decode_photo
from renderer.evaluate.compare import fullest_square
from renderer.evaluate.edges import FOLDER, SIDE_PX, ZOOM, draw_edges, without_cliplines
from renderer.splats.scene import GpuScene
from services.processes.compress import compress
from storage.packed.packed import PackedFile
from tests.effects_scans import N_CAMERAS, PARAMS, SIZE_PX, STEP, step_scan
from tests.pipeline.execution.test_stage import Heard
from tests.pipeline.readers.workspace import DISTANCE, centre_of


@pytest.fixture(scope="module")
def made(tmp_path_factory, renderer):
    """A wall with another before half of it, packed with its report."""
    folder = tmp_path_factory.mktemp("edges")
    step_scan(folder / "step", n_side=61)
    settings = settings_for("draft", max_atoms=0)
    report = compress(folder / "step", folder / "out", settings, SerialExecutor(), Heard(), work=folder / "work")
    return folder, report


def test_edges__stand_in_the_report_with_pictures_and_figures(made):
    folder, report = made
    assert [set(row["pictures"]) for row in report["edges"]] == [{"with", "without", "photo"}] * len(report["edges"])
    assert 2 <= len(report["edges"]) <= 4
    for row in report["edges"]:
        for path in row["pictures"].values():
            assert decode_photo(str(folder / "out" / path), path).shape == (SIDE_PX * ZOOM, SIDE_PX * ZOOM, 3)
        assert 0 <= row["left_px"] <= SIZE_PX[0] - row["side_px"] and 0 <= row["top_px"] <= SIZE_PX[1] - row["side_px"]
    page = (folder / "out" / "report.html").read_text()
    assert page.count('alt="With cliplines') == len(report["edges"]) == page.count('alt="Without cliplines')


def test_edges__are_found_where_the_near_wall_ends_and_come_nearer_to_the_photograph_with_lines(made):
    """The near half of the wall ends where x = 0 and z = -STEP."""
    _, report = made
    first = report["edges"][0]
    centre = centre_of(int(first["camera"].split(".")[0]), N_CAMERAS)
    edge = PARAMS[2] - PARAMS[0] * centre[0] / (DISTANCE - STEP)
    assert first["left_px"] < edge < first["left_px"] + first["side_px"]
    assert all(row["with_db"] > row["without_db"] for row in report["edges"][:-1])


def test_compare__the_fullest_square_is_that_of_brute_force():
    values = np.random.default_rng(1).integers(-50, 50, (19, 23))
    sums = {(r, c): int(values[r : r + 5, c : c + 5].sum()) for r in range(15) for c in range(19)}
    best = max(sums, key=lambda at: (sums[at], -at[0], -at[1]))
    assert fullest_square(values, 5) == (sums[best], *best)
    assert fullest_square(values[:3], 5)[1] == 0 and fullest_square(values[:2, :2], 5) == (values[:2, :2].sum(), 0, 0)


def test_edges__without_lines_is_the_same_file_drawn_without_their_code(made, renderer):
    folder, _ = made
    with PackedFile(folder / "out" / "step.splatpress") as packed:
        scene = packed.load()
    assert not any("clipline" in name for name in without_cliplines(scene).arrays)
    programs = {}
    for name, kept in (("with", scene), ("without", without_cliplines(scene))):
        gpu_scene = GpuScene(kept, renderer.context)
        programs[name] = renderer.render(gpu_scene, scene.header.cameras[0]).programs
        gpu_scene.release()
    assert any("clipline" in name for name in programs["with"]) and not any(
        "clipline" in name for name in programs["without"]
    )


def test_edges__of_a_file_without_lines_are_none(made, tmp_path):
    folder, _ = made
    compress(
        folder / "step",
        tmp_path / "out",
        settings_for("draft", max_atoms=0, effects="cliplines=off"),
        SerialExecutor(),
        Heard(),
        render=False,
        work=folder / "work",
    )
    assert draw_edges(tmp_path / "out" / "step.splatpress", next((folder / "work").glob("ingest-*")), tmp_path) == []
    assert not (tmp_path / FOLDER).exists()
