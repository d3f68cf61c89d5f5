"""The demo's scans: what kinds they are, and that a second run of the same program has nothing to compute."""

import json

import numpy as np
import pytest

from services.cli.main import main
from services.processes.demo import laser, volume
from services.processes.demo.scans import SCANS
from services.processes.inspect import check, inspect


@pytest.fixture
def small(tmp_path, monkeypatch):
    for module, name, value in ((laser, "N_KNOT", 900), (laser, "N_FLOOR", 600), (volume, "N_SIDE", 24)):
        monkeypatch.setattr(module, name, value)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def demo(scan: str, *more: str) -> int:
    return main(["demo", "--scan", scan, "--preset", "draft", "--executor", "serial", "--no-render", *more])


@pytest.mark.parametrize("scan", ["points", "volume"])
def test_demo__keeps_its_scan_and_shows_again_what_it_made_before(small, capsys, scan):
    out = small / SCANS[scan].out
    assert demo(scan) == 0
    first = {path.name: path.stat().st_mtime_ns for path in out.iterdir()}
    assert check(out / SCANS[scan].scan)["ok"]
    assert demo(scan, "--refresh") == 0
    said = capsys.readouterr()
    assert "made before by the same program" in said.err and f"{out.name}/scan.splatpress" in said.out
    assert {path.name: path.stat().st_mtime_ns for path in out.iterdir()} == first


def test_demo__makes_anew_what_is_damaged_or_of_other_settings(small, capsys):
    assert demo("volume") == 0
    packed = small / "demo-output-volume" / "scan.splatpress"
    whole = packed.read_bytes()
    packed.write_bytes(whole[: len(whole) // 2])
    assert demo("volume") == 1 and "--overwrite" in capsys.readouterr().err
    assert demo("volume", "--refresh") == 0 and packed.read_bytes() == whole
    assert main(["demo", "--scan", "volume", "--executor", "serial", "--no-render", "--json", "--refresh"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["settings"]["preset"] == "balanced"


def test_demo__its_points_are_alone_and_its_volume_is_one(tmp_path):
    points = inspect(laser.write_laser_scan(tmp_path))
    assert points["cameras"]["count"] == 0 and points["has_colors"] and not points["has_normals"]
    header = inspect(volume.write_volume(tmp_path))
    assert header["kind"] == "volume" and np.allclose(header["spacing"], volume.SPACING_MM)
    assert header["unit"] == "millimetre"
