"""Files in archive form, from the command line to every command that reads them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from services.cli.main import main
from services.processes.export import viewed
from storage.packed.packed import PackedFile

QUICK = ["--preset", "draft", "--no-render", "--executor", "serial"]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The same scan compressed into a plain file and into one in archive form."""
    folder = tmp_path_factory.mktemp("archive")
    scan = _ball(folder / "scan.ply", 2500)
    for form in ("off", "on"):
        assert main(["compress", str(scan), "--out", str(folder / form), "--archive", form, *QUICK]) == 0
    return folder


def _ball(path: Path, n: int) -> Path:
    """Points of a sphere, evenly, in colours of their places."""
    height, turn = 1 - 2 * (np.arange(n) + 0.5) / n, np.arange(n) * np.pi * (1 + 5**0.5)
    place = np.stack([np.sqrt(1 - height**2) * np.cos(turn), np.sqrt(1 - height**2) * np.sin(turn), height], axis=1)
    names = [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    names += [f"property uchar {name}" for name in ("red", "green", "blue")]
    rows = np.concatenate([place, place, np.rint(127 * (place + 1))], axis=1)
    lines = ["ply", "format ascii 1.0", f"element vertex {n}", *names, "end_header"]
    lines += [" ".join(f"{x:.5f}" for x in row[:6]) + " " + " ".join(str(int(x)) for x in row[6:]) for row in rows]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_archive__compress_makes_it_smaller_and_of_the_same_splats(made):
    plain, archive = (made / form / "scan.splatpress" for form in ("off", "on"))
    assert archive.stat().st_size < plain.stat().st_size
    with PackedFile(plain) as one, PackedFile(archive) as other:
        assert (one.is_archive, other.is_archive) == (False, True)
        assert other.header.settings["archive"] == "on"
        first, second = one.load(), other.load()
    for name in ("box_low", "box_bits", "batch_count"):
        assert np.array_equal(first.arrays[name], second.arrays[name])
    assert np.array_equal(np.sort(first.arrays["position"], axis=None), np.sort(second.arrays["position"], axis=None))


def test_archive__export_converts_both_ways(made, tmp_path, capsys):
    plain, archive = (made / form / "scan.splatpress" for form in ("off", "on"))
    assert main(["export", str(archive), "--to", "plain", "--out", str(tmp_path / "p")]) == 0
    assert main(["export", str(tmp_path / "p"), "--to", "archive", "--out", str(tmp_path / "a")]) == 0
    assert (tmp_path / "a").read_bytes() == archive.read_bytes()
    assert "packed splats" in capsys.readouterr().out
    assert main(["export", str(archive), "--to", "ply", "--out", str(tmp_path / "one.ply")]) == 0
    assert main(["export", str(tmp_path / "p"), "--to", "ply", "--out", str(tmp_path / "other.ply")]) == 0
    assert (tmp_path / "one.ply").read_bytes() == (tmp_path / "other.ply").read_bytes()


def test_archive__commands_read_both_forms(made, tmp_path, capsys):
    archive = made / "on" / "scan.splatpress"
    assert main(["inspect", str(archive), "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])
    assert main(["export", str(archive), "--to", "html", "--out", str(tmp_path / "page.html")]) == 0
    with viewed(archive, True) as plain, PackedFile(plain) as opened:
        assert not opened.is_archive and plain.name == archive.name
    assert not plain.exists()
