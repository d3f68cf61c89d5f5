"""Cliplines: which splats get one, and where it runs."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.effects.cliplines.eyes import _camera_eye, _station_eye, cell_of, eyes_of, seen_by_eye
from pipeline.effects.cliplines.lines import best_lines, candidates, disc_points
from pipeline.effects.cliplines.nearest import _keep_nearest
from pipeline.effects.cliplines.stage import FOREIGN_RADII, View, _cells_of, _foreign
from pipeline.execution.executors import SerialExecutor
from pipeline.geometry.cliplines import decode_cliplines, encode_cliplines
from pipeline.planning.settings import settings_for
from renderer.splats.baseline import clipline_codes
from services.flow.prepare import prepare
from services.flow.run import Run
from services.processes.compress import compress
from storage.packed.packed import PackedFile
from storage.packed.schema import Camera
from storage.work import arrays
from tests.effects_scans import step_scan, wall_scan
from tests.services.processes.test_compress import Heard


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

    class Sources:
        cameras, scan = (), SimpleNamespace(stations=())

    assert EFFECT.survey(Sources()) is None and eyes_of(Sources()) == ()
    assert EFFECT.conclude([], Sources()).value == 0


# --- the compiled loops, against plain arithmetic on arrays -----------------------------------------------------------


def turned_camera(seed: int) -> Camera:
    rotation = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    return Camera("a.png", 90, 60, 70.0, 75.0, 44.0, 31.0, tuple(map(tuple, rotation.tolist())), (0.3, -0.2, 0.1))


def cells_by_arrays(eye, scale: float, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row, column (-1 for none) and distance of points, as whole arrays."""
    local = points - eye.numbers[:3]
    if eye.around:
        distance = np.linalg.norm(local, axis=1)
        x = (np.arctan2(local[:, 1], local[:, 0]) + np.pi) * eye.cells_a_unit
        y = np.arccos(local[:, 2] / distance) * eye.cells_a_unit
    else:
        fx, fy, cx, cy = eye.numbers[12:]
        local = local @ eye.numbers[3:12].reshape(3, 3).T
        distance = np.where(local[:, 2] > 0, local[:, 2], np.nan)
        x, y = local[:, 0] / distance * fx + cx, local[:, 1] / distance * fy + cy
    row, column = np.floor(np.nan_to_num(y * scale, nan=-1)), np.floor(np.nan_to_num(x * scale, nan=-1))
    height, width = eye.shape(scale)
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    return np.where(inside, row, -1), np.where(inside, column, -1), np.where(inside, distance, np.nan)


@pytest.mark.parametrize("eye", [_camera_eye(turned_camera(1)), _station_eye(np.array([0.3, -0.2, 0.1]))])
def test_eyes__cells_of_points_are_those_of_plain_arithmetic_and_the_nearest_point_has_the_cell(eye):
    rng = np.random.default_rng(2)
    scale, points, origin = 0.25, rng.normal(size=(4000, 3)), np.array([5.0, -3.0, 2.0])
    points[3000:] = points[:1000]  # equal points: the first of them has the cell
    row, column, distance = cells_by_arrays(eye, scale, points)
    shape = eye.shape(scale)
    found = np.array([cell_of(eye.numbers, eye.around, scale, shape[1], shape[0], *point) for point in points])
    assert (row >= 0).sum() > 100 and np.array_equal(found[:, 0], row) and np.array_equal(found[:, 1], column)
    np.testing.assert_allclose(found[:, 2], distance, rtol=1e-12)
    seen = rng.random(4000) < 0.8
    position, nearest = np.full((*shape, 3), np.nan, np.float32), np.full(shape, np.inf)
    for part in (slice(0, 2500), slice(2500, 4000)):
        _keep_nearest(position, nearest, eye.numbers, eye.around, scale, points[part] - origin, origin, seen[part])
    for cell in {(r, c) for r, c in zip(row[seen].astype(int), column[seen].astype(int)) if r >= 0}:
        rows = np.flatnonzero(seen & (row == cell[0]) & (column == cell[1]))
        first = rows[distance[rows].argmin()]
        assert np.array_equal(position[cell], (points[first] - origin).astype(np.float32))
        nearest[cell] = np.inf
    assert np.isinf(nearest).all()  # and no other cell has any


def test_eyes__a_box_with_anything_in_the_picture_is_never_left_out_and_most_others_are():
    rng = np.random.default_rng(3)
    needless = 0
    for seed in range(200):
        eye = _camera_eye(turned_camera(seed))
        low = rng.uniform(-4, 4, 3)
        high = low + rng.uniform(0.1, 2, 3)
        inside = cells_by_arrays(eye, 1.0, rng.uniform(low, high, (300, 3)))[0] >= 0
        assert eye.may_see(low, high) or not inside.any()
        needless += eye.may_see(low, high) and not inside.any()
    assert needless < 40
    assert _station_eye(np.zeros(3)).may_see(np.ones(3), np.full(3, 2.0))


def test_eyes__what_one_eye_sees_is_its_column_of_what_all_see(step):
    scan, run = step
    block = prepare(run, scan, None, "").sources.block(0)
    found = np.stack([seen_by_eye(block, i) for i in range(block.seen.shape[1])], axis=1)
    assert 0 < found.mean() < 1 and np.array_equal(found, block.seen)


def test_cliplines__a_point_of_a_disc_is_foreign_where_what_was_seen_there_lies_off_its_plane(step):
    scan, run = step
    sources = prepare(run, scan, None, "").sources
    block, (eye, *_) = sources.block(0), eyes_of(sources)
    rows, scale = np.arange(0, 6000, 7), 0.5
    nearest = np.random.default_rng(4).normal(size=(*eye.shape(scale), 3)).astype(np.float32) * 2 * sources.radius
    nearest += np.array([0, 0, block.centre[:, 2].mean()], np.float32)
    points, _ = disc_points()
    u, v, normal = (axis[rows, None] for axis in block.frame)
    centre = block.centre[rows, None]
    on_disc = centre + sources.radius * (points[:, :1] * u + points[:, 1:] * v) + sources.origin
    row, column, _ = (a.reshape(on_disc.shape[:2]) for a in cells_by_arrays(eye, scale, on_disc.reshape(-1, 3)))
    off = ((nearest[row.astype(int), column.astype(int)] - centre) * normal).sum(axis=2)
    wanted = (row >= 0) & (np.abs(off) > FOREIGN_RADII * sources.radius)
    view = View(eye, scale, nearest.shape[:2])
    for some in (rows, rows[block.centre[rows, 0] > 0.2]):  # of some discs a part of the picture is enough
        top, bottom, left, right = _cells_of(block, some, view)
        inside = (row >= 0)[np.isin(rows, some)]
        assert (row[np.isin(rows, some)][inside].min(), row[np.isin(rows, some)][inside].max()) == (top, bottom - 1)
        known = nearest[top:bottom, left:right]
        found = _foreign(block, some, view, known, (top, left), FOREIGN_RADII)
        assert wanted.mean() > 0.05 and np.array_equal(found, wanted[np.isin(rows, some)])
