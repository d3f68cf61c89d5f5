"""Cliplines: which splats get one, and where it runs."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.effects.cliplines.lines import best_lines, candidates, disc_points
from pipeline.executors import SerialExecutor
from pipeline.geometry.cliplines import decode_cliplines, encode_cliplines
from pipeline.settings import settings_for
from renderer.baseline import clipline_codes
from services.workflow import Run, compress, prepare
from storage import arrays
from storage.packed import PackedFile
from tests.effects_scans import step_scan, wall_scan
from tests.services.test_workflow import Heard


def cut_by(line: tuple[float, float, float]) -> np.ndarray:
    """Which points of the disc a line leaves to another surface, (1, m) bool."""
    points, _ = disc_points()
    return (points @ line[:2] + line[2] < 0)[None]


@pytest.mark.parametrize("angle", np.arange(12) * 0.55)
@pytest.mark.parametrize("offset", [0.0, 0.3, 0.6])
def test_lines__finds_the_line_that_parts_two_surfaces(angle, offset):
    foreign = cut_by((np.cos(angle), np.sin(angle), offset))
    code, gain = best_lines(foreign)
    points, weight = disc_points()
    a, b, c = decode_cliplines(code)[0]
    wrong = weight[(points @ [a, b] + c < 0) != foreign[0]].sum()
    assert wrong < 0.06 and gain[0] == pytest.approx(weight[foreign[0]].sum() - wrong, abs=0.06)


def test_lines__gains_nothing_where_there_is_nothing_to_clip_or_no_line_parts_it():
    points, _ = disc_points()
    ring = (np.linalg.norm(points, axis=1) > 0.75)[None]
    assert best_lines(np.zeros((1, len(points)), bool))[1][0] <= 0
    assert best_lines(ring)[1][0] < 0.06  # a line clips as much as the ring from the middle


def test_lines__every_candidate_is_a_code_and_keeps_the_centre():
    codes, _ = candidates()
    line = decode_cliplines(codes)
    assert (encode_cliplines(line) == codes).all() and (line[:, 2] >= 0).all() and len(np.unique(codes)) == len(codes)


@pytest.fixture(scope="module")
def step(tmp_path_factory) -> tuple[Path, Run]:
    folder = tmp_path_factory.mktemp("step")
    return step_scan(folder / "step"), Run(folder / "work", SerialExecutor(), Heard())


def test_cliplines__run_along_the_edge_of_a_step_and_nowhere_else(step):
    scan, run = step
    prepared = prepare(run, scan, None, "")
    sources, folder = prepared.sources, dict(prepared.built)["cliplines"]
    has, line = arrays.read(folder, "has_clipline"), decode_cliplines(arrays.read(folder, "clipline"))
    block = sources.block(0)
    position, (u, v, _) = block.centre + sources.origin, block.frame
    near, radius = position[:, 2] < -0.25, sources.radius
    on_edge = near & (position[:, 0] < 0.5 * radius) & (np.abs(position[:, 1]) < 0.45)  # beyond, nothing is seen behind
    assert on_edge.sum() > 15 and has[on_edge].mean() > 0.9
    # A line a x + b y + c has its kept side towards (a, b) of the tangents: away from the step, so to the right.
    towards = (line[:, :1] * u + line[:, 1:2] * v)[on_edge & has]
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    assert (towards[:, 0] > 0.85).mean() > 0.9
    assert not has[near & (position[:, 0] > 2.5 * radius)].any()
    assert not has[~near & (position[:, 0] < -0.4)].any()  # far from all that hides the far half
    row = next(row for row in prepared.effects.rows if row.effect == "cliplines")
    assert row.enabled and row.share == pytest.approx(has.mean(), abs=0.01)


def test_cliplines__a_wall_has_none_and_neither_stage_nor_bytes(tmp_path):
    scan = wall_scan(tmp_path / "wall")
    settings = settings_for("draft", max_atoms=0)
    made = compress(scan, tmp_path / "out", settings, SerialExecutor(), Heard(), render=False)
    assert "cliplines" not in [stage["name"] for stage in made["stages"]]
    assert "cliplines" not in made["sizes"]["arrays"]
    assert next(row for row in made["effects"] if row["effect"] == "cliplines")["measure"] == 0


def test_cliplines__packed_ones_are_those_of_the_stage_and_off_leaves_none(step, tmp_path):
    scan, run = step
    for request, some in (("", True), ("cliplines=off", False)):
        settings = settings_for("draft", max_atoms=0, effects=request)
        compress(scan, tmp_path / "out", settings, SerialExecutor(), Heard(), render=False, work=run.work)
        with PackedFile(tmp_path / "out" / "step.splatpress") as packed:
            scene = packed.load()
        assert ("cliplines" in scene.arrays) == some == any(batch.clipline for batch in scene.header.batches)
        if some:
            folder = dict(prepare(run, scan, None, "").built)["cliplines"]
            stored, has = arrays.read(folder, "clipline"), arrays.read(folder, "has_clipline")
            found = clipline_codes(scene)[scene.rows.clipline >= 0]
            assert np.array_equal(np.sort(found), np.sort(stored[has]))


def test_cliplines__points_that_nothing_saw_from_anywhere_have_none():
    from pipeline.effects.cliplines import EFFECT
    from pipeline.effects.cliplines.eyes import eyes_of

    class Sources:
        cameras, scan = (), {"stations": []}

    assert EFFECT.survey(Sources()) is None and eyes_of(Sources()) == ()
    assert EFFECT.conclude([], Sources()).value == 0
