"""Whole scans: whatever they hold, they end in finite output or in one clear error. Bounds: docs/NUMERICS.md."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pipeline.numerics.limits import LARGEST_COORDINATE, SMALLEST_RADIUS
from pipeline.readers.check import check_scan
from pipeline.stages.packed.measure import decoded_colors
from pipeline.texture.colors import length_of
from services.cli.main import main
from services.processes.compress import compress
from storage.errors import InvalidScan, SplatpressError
from tests.hard_cases.scans import (
    QUICK,
    Placed,
    arrays_of_packed,
    compressed,
    grained_photo,
    photographed_wall,
    scene_of_packed,
    write_photographed,
    write_points,
)
from tests.pipeline.execution.test_stage import Heard
from tests.pipeline.readers.shared_data import shared_scan

WILD = st.one_of(
    st.floats(-1, 1),
    st.floats(-1e3, 1e3),
    st.floats(width=64),
    st.sampled_from(
        [0.0, -0.0, 1e-300, 1e-45, 1e-20, 1e15, 1e16, 1e38, 1e39, 1e308, np.inf, -np.inf, np.nan, 5.4e6, 4.5e5]
    ),
)
HYPOTHESIS = {"deadline": None, "derandomize": True, "database": None, "suppress_health_check": list(HealthCheck)}


@st.composite
def wild_points(draw):
    """Positions, perhaps normals, perhaps colours, of 0 to 300 points; some of them copies."""
    seed, n = draw(st.integers(0, 2**32 - 1)), draw(st.sampled_from([0, 1, 2, 3, 5, 17, 127, 128, 129, 300]))
    rng = np.random.default_rng(seed)
    position = rng.uniform(-1, 1, (n, 3)) * draw(st.sampled_from([1.0, 1e-6, 1e-14, 1e6, 1e14])) + draw(
        st.sampled_from([0.0, 5.4e6])
    )
    for value in draw(st.lists(WILD, max_size=4)):
        if n:
            position[rng.integers(0, n, 1 + n // 10), rng.integers(0, 3)] = value
    if n and draw(st.booleans()):
        position[rng.integers(0, n, n // 2)] = position[0]
    normal = color = None
    if draw(st.booleans()):
        normal = rng.standard_normal((n, 3)).astype(np.float32)
        normal[rng.random(n) < 0.2] = draw(st.sampled_from([0.0, np.nan, np.inf, 1e-40, 3e38]))
    if draw(st.booleans()):
        color = rng.integers(0, 256, (n, 3)).astype(np.uint8)
    return position, normal, color


def ends_well(scan: Path, out: Path, render: bool = False) -> dict | None:
    """The report of a scan that went through with finite numbers alone, or None where it was refused clearly."""
    try:
        report, packed = compressed(scan, out, render=render)
    except SplatpressError as error:
        assert error.kind == "data" and len(str(error)) < 2000 and not out.exists()
        return None
    json.dumps(report, allow_nan=False)
    assert all(np.isfinite(a).all() for a in arrays_of_packed(packed).values() if a.dtype.kind == "f")
    return report


@settings(max_examples=25, **HYPOTHESIS)
@given(wild_points())
def test_whole__points_of_any_value_end_in_finite_output_or_one_clear_error(points):
    position, normal, color = points
    with tempfile.TemporaryDirectory() as folder:
        scan = write_points(Path(folder) / "scan.ply", position, normal, color)
        report = ends_well(scan, Path(folder) / "out")
        refused = any(f.severity == "error" for f in check_scan(str(scan)))
        assert not (refused and report), "check refuses what compress takes"
        if report:
            assert report["numerics"]["dropped_points"] == int((~np.isfinite(position).all(axis=1)).sum())
            assert report["splats"] == len(position) - report["numerics"]["dropped_points"]


@st.composite
def odd_cameras(draw):
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    cameras = []
    for _ in range(draw(st.integers(1, 3))):
        turn = Rotation.random(random_state=rng).as_matrix() if draw(st.booleans()) else np.eye(3)
        centre = np.array([0.0, 0, draw(st.sampled_from([-2.0, 0.0, -1e-9, -1e9, 1.0, 0.05, -0.1]))])
        cameras.append(
            (
                draw(st.sampled_from([1e-6, 1.0, 60.0, 1e7])),
                draw(st.sampled_from([50.0, 1e-3, 1e9])),
                draw(st.sampled_from([80.0, -1e6])),
                60.0,
                turn,
                centre,
            )
        )
    n = draw(st.sampled_from([6, 40, 150]))
    position = rng.uniform(-1, 1, (n, 3)) * draw(st.sampled_from([[1, 1, 0], [1, 1, 1], [1, 0, 0]]))
    position[: n // 5] = position[0]
    normal = rng.standard_normal((n, 3)).astype(np.float32) * (rng.random((n, 1)) < 0.8)
    visible = tuple(tuple(range(rng.integers(0, len(cameras) + 1))) for _ in range(n)) if draw(st.booleans()) else None
    return position, normal, cameras, visible


@settings(max_examples=15, **HYPOTHESIS)
@given(odd_cameras())
def test_whole__odd_cameras_end_in_finite_output_or_one_clear_error(scan):
    position, normal, cameras, visible = scan
    with tempfile.TemporaryDirectory() as folder:
        color = np.full((len(position), 3), 90, np.uint8)
        path = write_photographed(
            Path(folder) / "scan",
            position,
            normal,
            color,
            visible,
            cameras,
            [grained_photo(i) for i in range(len(cameras))],
        )
        report = ends_well(path, Path(folder) / "out")
        assert report is None or 0 <= report["numerics"]["flagged_projections"] <= report["splats"]


# --- too large, too small
# -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [1e16, 1e39, 1e300, -1e39])
def test_whole__a_scan_wider_than_float32_is_refused_with_the_value(tmp_path, value):
    position = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    position[7, 1] = value
    scan = write_points(tmp_path / "wide.ply", position)
    with pytest.raises(InvalidScan, match=r"a coordinate of 1e\+.*allowed: -1e\+15 to 1e\+15"):
        compressed(scan, tmp_path / "out")


@pytest.mark.parametrize("extent", [LARGEST_COORDINATE, 1e3 * SMALLEST_RADIUS])
def test_whole__the_largest_and_the_smallest_scans_are_drawn(tmp_path, renderer, extent):
    rng = np.random.default_rng(0)
    position = np.column_stack([rng.uniform(-1, 1, (300, 2)), np.zeros(300)]) * extent
    report, _ = compressed(write_points(tmp_path / "scan.ply", position), tmp_path / "out", render=True)
    assert report["quality"]["geometry"]["mean_position_error_in_radii"] < 0.1
    assert max(view["coverage"] for view in report["quality"]["views"]) > 0.02


@pytest.mark.parametrize("radius", [1e-13, 1e16, 1e300])
def test_whole__a_radius_that_squares_cannot_hold_is_refused(tmp_path, radius, capsys):
    scan = write_points(tmp_path / "scan.ply", np.random.default_rng(0).uniform(-1, 1, (50, 3)))
    code = main(
        [
            "compress",
            str(scan),
            "--out",
            str(tmp_path / "out"),
            "--radius",
            str(radius),
            "--executor",
            "serial",
            "--no-render",
        ]
    )
    assert code == 3 and f"a splat radius of {radius:g}; allowed: 1e-12 to 1e+15" in capsys.readouterr().err


def test_whole__intensities_that_are_not_finite_are_black_and_break_nothing(tmp_path):
    rng = np.random.default_rng(0)
    rows = np.column_stack([rng.uniform(-1, 1, (60, 3)), rng.uniform(0, 10, 60)])
    for n_bad in (5, 60):
        rows[:n_bad, 3] = np.nan
        text = "\n".join(" ".join(f"{v:g}" for v in row) for row in rows)
        scan = tmp_path / f"{n_bad}.ply"
        scan.write_text(
            "ply\nformat ascii 1.0\nelement vertex 60\n"
            + "".join(f"property float {p}\n" for p in ("x", "y", "z", "intensity"))
            + f"end_header\n{text}\n"
        )
        report, packed = compressed(scan, tmp_path / f"out{n_bad}")
        color = arrays_of_packed(packed)["color"]
        assert report["splats"] == 60 and (
            (color == 0).all(axis=1).sum() >= 5 if n_bad < 60 else ((color > 30) & (color < 225)).all()
        )


# --- the same scan elsewhere
# ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def wall(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wall")
    return compressed(photographed_wall(folder / "scan", n_side=N_SIDE), folder / "out", LEARNED)


N_SIDE = 70  # of the wall: what fewer splats teach a dictionary hangs on the last digit of each
LEARNED = replace(QUICK, training_splats=4000)
QUARTER = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])


@pytest.mark.parametrize(
    "placed",
    [
        Placed(np.eye(3), shift=(4.5e5, 5.4e6, 100.0)),
        Placed(np.eye(3), 1e-6),
        Placed(np.eye(3), 1e6),
        Placed(QUARTER),
        Placed(QUARTER, 1000.0, (-3e5, 1e5, 2e6)),
    ],
    ids=["far", "tiny", "huge", "turned by axes", "all three"],
)
def test_whole__moving_turning_and_scaling_leave_psnr(tmp_path, wall, placed):
    report, packed = compressed(photographed_wall(tmp_path / "scan", placed, N_SIDE), tmp_path / "out", LEARNED)
    for figure in ("texture_psnr_db", "visible_psnr_db"):
        assert report["quality"][figure] == pytest.approx(wall[0]["quality"][figure], abs=0.05)
    mine, moved = (r["quality"]["geometry"]["mean_position_error_in_radii"] for r in (wall[0], report))
    assert moved == pytest.approx(mine, rel=0.35)


def test_whole__turning_a_scan_by_any_angles_leaves_psnr(tmp_path):
    """Chunks then hold other splats, but learning starts from the same ones."""
    settings = replace(QUICK, training_splats=4000)
    turns = (
        np.eye(3),
        *(Rotation.from_euler("zyx", angles, degrees=True).as_matrix() for angles in ((10, 20, 30), (115, -40, 65))),
    )
    still, *turned = (
        compressed(photographed_wall(tmp_path / f"scan{i}", Placed(turn), n_side=60), tmp_path / f"out{i}", settings)[0]
        for i, turn in enumerate(turns)
    )
    for report in turned:
        for figure in ("texture_psnr_db", "visible_psnr_db"):
            assert report["quality"][figure] == pytest.approx(still["quality"][figure], abs=0.05)
        assert (
            report["quality"]["geometry"]["mean_position_error_in_radii"] < 1 / 30
        )  # a tilted wall's boxes are thicker


def test_whole__patches_of_a_far_scan_are_those_of_the_near_one(tmp_path):
    placed = (Placed(np.eye(3)), Placed(np.eye(3), shift=(4.5e5, 5.4e6, 128.0)))
    near, far = (
        scene_of_packed(compressed(photographed_wall(tmp_path / f"scan{i}", p), tmp_path / f"out{i}")[1])
        for i, p in enumerate(placed)
    )
    apart = np.abs(decoded_colors(near) - decoded_colors(far))  # a colour may fall into the next cell, few do
    assert apart.max() <= 1.7 * length_of(near.header.color_step) and np.median(apart) < 0.05
    assert (near.arrays["normal"] == far.arrays["normal"]).all()


# --- order and workers
# -----------------------------------------------------------------------------------------------------


class _Backwards:
    """Tasks in an order of its own, some of them twice."""

    n_workers = 1

    def run(self, stage, folder, indices, on_done):
        from pipeline.execution.task import run_task

        for index in [*indices[::-1], *indices[:1]][: len(indices) + 1]:
            result = run_task(stage, folder, index)
            if index in indices:
                on_done(index, result)

    def call(self, name, function, *arguments):
        return function(*arguments)


def test_whole__bytes_do_not_depend_on_the_order_of_tasks(tmp_path, wall, monkeypatch):
    compress(
        photographed_wall(tmp_path / "scan", n_side=N_SIDE),
        tmp_path / "out",
        LEARNED,
        _Backwards(),
        Heard(),
        render=False,
    )
    assert (tmp_path / "out" / wall[1].name).read_bytes() == wall[1].read_bytes()


# --- in the product
# ----------------------------------------------------------------------------------------------------------


def test_whole__the_report_counts_what_was_met(tmp_path, renderer):
    position = np.concatenate(
        [
            np.random.default_rng(0).uniform(-1, 1, (200, 3)),
            np.full((7, 3), np.nan),
            np.outer(np.linspace(50, 60, 30), [1, 0, 0]),
        ]
    )
    scan = write_points(tmp_path / "scan.ply", position)
    report, _ = compressed(scan, tmp_path / "out", render=True)
    numerics = report["numerics"]
    assert numerics["dropped_points"] == 7 and 20 <= numerics["degenerate_normals"] <= 40
    assert numerics["flagged_projections"] == numerics["replaced_atoms"] == numerics["safeguard_steps"] == 0
    assert numerics["accumulation"] in ("RGBA16F", "RGBA32F")
    page = (tmp_path / "out" / "report.html").read_text()
    assert "7 points have a position that is not finite: dropped." in page and "Hard cases" in page


def test_whole__the_report_says_when_sums_are_wide(tmp_path, renderer):
    position = np.concatenate(
        [np.random.default_rng(0).uniform(-1, 1, (200, 3)) * [1, 1, 0], np.full((400, 3), [0.25, 0.25, 0])]
    )
    normal = np.tile(np.float32([0, 0, 1]), (600, 1))
    report, _ = compressed(write_points(tmp_path / "scan.ply", position, normal), tmp_path / "out", render=True)
    assert report["numerics"]["accumulation"] == "RGBA32F"
    assert "added up in 32 bits" in (tmp_path / "out" / "report.html").read_text()


def test_whole__projections_beyond_a_photo_and_without_one_are_counted(wall):
    numerics = wall[0]["numerics"]
    assert set(numerics) == {
        "dropped_points",
        "degenerate_normals",
        "flagged_projections",
        "replaced_atoms",
        "safeguard_steps",
        "accumulation",
    }
    assert numerics["accumulation"] is None and numerics["dropped_points"] == 0
    curve = [row["psnr_db"] for row in wall[0]["learning"]]
    assert curve == sorted(curve)


def test_whole__check_prints_a_line_a_finding_and_exits_with_0_or_3(tmp_path, capsys):
    rng = np.random.default_rng(0)
    good = write_points(tmp_path / "good.ply", rng.uniform(-1, 1, (50, 3)))
    odd = rng.uniform(-1, 1, (50, 3)) + [5e5, 0, 0]
    odd[:3] = np.nan
    normal = np.zeros((50, 3), np.float32)
    cases = {
        "good": (good, 0, []),
        "odd": (
            write_points(tmp_path / "odd.ply", odd, normal),
            0,
            ["3 of 50 points have a position", "47 of 50 points have a normal", "the points lie"],
        ),
        "wide": (write_points(tmp_path / "wide.ply", np.diag([1e300, 1, 1])), 3, ["error: ", "a coordinate of 1e+300"]),
        "none": (write_points(tmp_path / "none.ply", np.full((5, 3), np.nan)), 3, ["none of its 5 points"]),
        "equal": (write_points(tmp_path / "equal.ply", np.ones((5, 3))), 0, ["all points are one position"]),
    }
    (tmp_path / "cut.ply").write_bytes(good.read_bytes()[:-9])
    cases["cut"] = (tmp_path / "cut.ply", 3, ["the file may be truncated"])
    for scan, code, words in cases.values():
        assert main(["check", str(scan)]) == code
        out = capsys.readouterr().out
        assert all(word in out for word in words) and ("warning: " in out or "error: " in out) == bool(words)
        assert out.splitlines()[-1] == ("not ok: see above" if code else "ok: compress takes it")
        assert main(["check", str(scan), "--json"]) == code
        found = json.loads(capsys.readouterr().out)
        assert found["ok"] == (code == 0) and len(found["findings"]) + 1 == len(out.splitlines())


REAL = [
    "autzen_rgb_statefeet/autzen_trim.las",
    "organised_table_scene/scan.ply",
    "tree_spruce_tls/spruce.laz",
    "stanford_bunny/bunny.ply",
]


@pytest.mark.parametrize("name", REAL)
def test_whole__real_hard_scans_pass_readers_and_geometry(tmp_path, name):
    from pipeline.execution.executors import SerialExecutor
    from services.flow.prepare import prepare
    from services.flow.run import Run

    scan = shared_scan(name)
    assert all(f.severity != "error" for f in check_scan(str(scan)))
    run = Run(tmp_path, SerialExecutor(), Heard())
    discs = prepare(run, scan, None, "ellipsoids=off")
    made = discs.splats.summary
    assert made.mean_position_error < 0.05 * discs.radius and made.mean_normal_error_degrees < 0.35
    # Against the scanned points, too: ellipsoids lie where a branch has its middle, not where the scanner met its bark.
    drawn = prepare(run, scan, None)
    assert drawn.splats.summary.mean_position_error < 0.12 * drawn.radius
