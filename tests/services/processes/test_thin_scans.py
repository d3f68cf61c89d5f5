"""Ellipsoids from a scan to its packed file, where the scan calls for them and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.effects.ellipsoids import stage
from pipeline.execution.executors import DaskExecutor, SerialExecutor
from pipeline.planning.settings import settings_for
from services.processes.compress import compress
from services.processes.report import report
from storage.packed.packed import PackedFile
from storage.work import arrays
from tests.pipeline.execution.test_stage import Heard
from tests.pipeline.readers.workspace import write_ply
from tests.services.scans import photo_scan
from tests.thin_scene import THIN, room, scan


def compressed(path, out, effects="", executor=SerialExecutor()):
    settings = settings_for("draft", target_psnr_db=32.0, training_splats=1000, iterations=1, effects=effects)
    made = compress(path, out, settings, executor, Heard(), render=False)
    packed = next(out.glob("*.splatpress"))
    with PackedFile(packed) as opened:
        return made, packed, opened.load()


def row_of(made, name="ellipsoids"):
    return next(row for row in made["effects"] if row["effect"] == name)


@pytest.fixture(scope="module")
def thin_scan(tmp_path_factory):
    return scanned_room(tmp_path_factory.mktemp("scan") / "room.ply")


def scanned_room(path, step=0.0042):
    """A scanner's points with colours by what they lie on, and no photograph."""
    rng = np.random.default_rng(3)
    seen = scan(room(rng), (2.6, -1.6, 1.6), step, 0.0015, rng)
    color = np.where(np.isin(seen.kind, THIN)[:, None], [200, 0, 0], [0, 0, 200]).astype(np.uint8)
    write_ply(path, seen.position, np.tile([0.0, 0.0, 1.0], (len(color), 1)), color)
    return path


def test_thin__a_scan_without_photographs_gets_ellipsoids_on_its_thin_parts(thin_scan, tmp_path):
    made, packed, scene = compressed(thin_scan, tmp_path / "out")
    row = row_of(made)
    assert row["enabled"] and row["share"] == pytest.approx(len(scene.ellipsoids[0]) / scene.header.n_splats, abs=0.01)
    thin = scene.arrays["color"][:, 0] == 200
    found = np.zeros(len(thin), bool)
    found[scene.ellipsoids[0]] = True
    assert found[thin].mean() > 0.65 and found[~thin].mean() < 0.02
    assert made["sizes"]["arrays"]["ellipsoids"] == 4 * (found.sum() + 1)
    assert "ellipsoids" in [s["name"] for s in made["stages"]]


def test_thin__dask_packs_the_same_bytes_as_the_serial_executor(tmp_path):
    """Of several blocks, so that neighbourhoods reach across tasks."""
    path = scanned_room(tmp_path / "room.ply", step=0.0034)
    _, serial, scene = compressed(path, tmp_path / "serial", "ellipsoids=on")
    with DaskExecutor(2) as executor:
        _, dask, _ = compressed(path, tmp_path / "dask", "ellipsoids=on", executor=executor)
    assert len(scene.ellipsoids[0]) > 100 and scene.header.n_splats > arrays.BLOCK
    assert serial.read_bytes() == dask.read_bytes()


def test_thin__what_is_asked_to_be_off_leaves_no_stage_and_no_byte(thin_scan, tmp_path):
    made, _, scene = compressed(thin_scan, tmp_path / "out", "ellipsoids=off")
    assert not row_of(made)["enabled"] and "ellipsoids" not in [s["name"] for s in made["stages"]]
    assert not any("ellipsoid" in name for name in scene.arrays) and not any(b.ellipsoid for b in scene.header.batches)


def test_thin__a_flat_photographed_scan_calls_for_none(tmp_path):
    made, _, scene = compressed(photo_scan(tmp_path / "flat", n_side=60), tmp_path / "out")
    assert not row_of(made)["enabled"] and row_of(made)["share"] < 0.005
    assert "ellipsoids" not in scene.arrays


def test_thin__textures_of_ellipsoids_are_sampled_where_the_packed_file_puts_them(tmp_path, monkeypatch):
    """A report that samples the photographs anew, in the frames of the packed file, finds the figures of the run."""
    monkeypatch.setattr(stage, "thin_splats", lambda point, *_: np.arange(len(point)) % 5 == 0)
    path = photo_scan(tmp_path / "scan", n_side=60)
    made, packed, scene = compressed(path, tmp_path / "out", "ellipsoids=on")
    assert len(scene.ellipsoids[0]) == 720
    again = report(packed, path, tmp_path / "again", SerialExecutor(), Heard(), render=False)
    for name in ("texture_psnr_db", "visible_psnr_db"):
        # But for what splats without a photograph lose to cells of colours: a report does not know what they were.
        assert again["quality"][name] == pytest.approx(made["quality"][name], abs=0.02)
