"""Scans whose points lie very unevenly: each splat as large as its own surroundings ask for, whatever the rest does."""

import numpy as np
import pytest

from pipeline.execution.executors import SerialExecutor
from pipeline.splats.decoded import scene_radii
from services.processes.compress import compress
from storage.packed.packed import SUFFIX, PackedFile
from tests.hard_cases.scans import QUICK, write_points
from tests.pipeline.execution.test_stage import Heard


def packed(tmp_path, position, settings=QUICK):
    """The report, and the scene as packed."""
    scan = write_points(tmp_path / "scan.ply", position)
    report = compress(scan, tmp_path / "out", settings, SerialExecutor(), Heard(), render=False)
    with PackedFile(tmp_path / "out" / f"scan{SUFFIX}") as opened:
        scene = opened.load()
    return report, scene


def row_of(report, name="sizes"):
    return next(row for row in report["effects"] if row["effect"] == name)


def wall(n: int, step: float, at: float = 0.0) -> np.ndarray:
    x, z = np.meshgrid(np.arange(n) * step, np.arange(n) * step)
    return np.column_stack([x.ravel() + at, np.zeros(n * n), z.ravel()])


def test_sizes__spacing_that_varies_a_thousandfold_is_followed(tmp_path):
    """Along x a wall's points lie ever further apart, from a millimetre to a metre."""
    step = 0.001 * 1000 ** (np.arange(120) / 119)
    x = np.cumsum(step)
    parts = [np.column_stack([np.full(40, a), np.zeros(40), s * np.arange(40)]) for a, s in zip(x, step, strict=True)]
    report, scene = packed(tmp_path, np.concatenate(parts))
    assert row_of(report)["enabled"] and scene.header.size_bits == 3
    radius = scene_radii(scene)
    assert radius.max() / radius.min() > 300
    from pipeline.splats.decoded import scene_positions

    own = np.interp(scene_positions(scene)[:, 0] + scene.header.origin[0], x, step)
    inside = np.abs(np.log(radius / own)) < np.log(2.5)
    assert inside.mean() > 0.97


def test_sizes__an_even_wall_keeps_one_radius_and_pays_nothing(tmp_path):
    report, scene = packed(tmp_path, wall(90, 0.01))
    row = row_of(report)
    assert not row["enabled"] and 0 <= row["measure"] < row["threshold"]
    assert scene.header.size_bits == 0 and not {"sizes", "size_scale"} & scene.arrays.keys()


def test_sizes__one_far_stray_is_no_larger_than_the_surface(tmp_path):
    position = np.concatenate([wall(60, 0.01), wall(20, 0.04, at=2.0), [[0.3, 500.0, 0.3]]])
    _, scene = packed(tmp_path, position)
    assert scene.header.size_bits and scene_radii(scene).max() < 4 * 0.04


@pytest.mark.parametrize("name", ["line", "copies beside a wall", "five points"])
def test_sizes__of_lines_copies_and_handfuls_are_finite(tmp_path, name):
    position = {
        "line": np.column_stack([np.cumsum(1.01 ** np.arange(600)), np.zeros((600, 2))]),
        "copies beside a wall": np.concatenate([wall(40, 0.01), np.tile([[3.0, 0.0, 3.0]], (900, 1))]),
        "five points": np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [9, 9, 9]], float),
    }[name]
    _, scene = packed(tmp_path, position)
    radius = scene_radii(scene)
    assert np.isfinite(radius).all() and (radius > 0).all()


def test_sizes__are_the_same_bytes_for_any_order_of_tasks_and_none_with_a_radius(tmp_path):
    rng = np.random.default_rng(1)
    position = np.concatenate([rng.random((20_000, 3)) * [1, 0, 1], rng.random((2_000, 3)) * [3, 0, 3] + [2, 0, 0]])
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    _, first = packed(tmp_path / "a", position)

    class Backwards(SerialExecutor):
        def run(self, stage, folder, indices, on_done):
            super().run(stage, folder, indices[::-1], on_done)

    scan = write_points(tmp_path / "b" / "scan.ply", position)
    compress(scan, tmp_path / "b" / "out", QUICK, Backwards(), Heard(), render=False)
    made = [(tmp_path / name / "out" / f"scan{SUFFIX}").read_bytes() for name in "ab"]
    assert first.header.size_bits == 3 and made[0] == made[1]
    (tmp_path / "c").mkdir()
    report, fixed = packed(tmp_path / "c", position, settings=QUICK.__class__(**{**QUICK.__dict__, "radius": 0.02}))
    assert fixed.header.size_bits == 0 and fixed.header.radius == 0.02 and not row_of(report)["enabled"]
