"""The verbs `pages`, `path` and `fly` on a small made scene."""

import json

import pytest

from renderer.residency import paths, simulate
from renderer.residency.paths import read_path
from renderer.residency.places import Screen
from services.cli.main import main
from services.processes.pages.table import as_text
from storage.pages.file import PageFile
from tests.effects_scans import wall_scan
from tests.services.scans import point_scan


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    return wall_scan(tmp_path_factory.mktemp("scan") / "wall", 30)


def run(*arguments) -> int:
    return main(["pages", *map(str, arguments), "--executor", "serial"])


def test_pages__of_a_scan_and_of_its_work_folder_are_the_same_file(scan, tmp_path, capsys):
    work = tmp_path / "work"
    assert run(scan, "--out", tmp_path / "a.pages", "--page-size", 64, "--work", work, "--json") == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    with PageFile(tmp_path / "a.pages") as file:
        assert found["n_pages"] == file.layout.n_pages and found["n_photographs"] == len(file.header.names)
        assert found["bytes"] == (tmp_path / "a.pages").stat().st_size and found["psnr_db"] > 30
    assert run(work, "--out", tmp_path / "b.pages", "--page-size", 64) == 0
    assert (tmp_path / "a.pages").read_bytes() == (tmp_path / "b.pages").read_bytes()


def test_pages__refuses_scans_without_photographs_and_wrong_forms(scan, tmp_path, capsys):
    assert run(point_scan(tmp_path / "points.ply", 50), "--out", tmp_path / "a.pages") == 3
    assert "no photograph" in capsys.readouterr().err
    for wrong in (["--page-size", "130"], ["--page-size", "16"], ["--quality", "0"]):
        assert run(scan, "--out", tmp_path / "a.pages", *wrong) == 1
    (tmp_path / "there.pages").write_text("")
    assert run(scan, "--out", tmp_path / "there.pages") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["points.ply", "there.pages"] or not (tmp_path / "a.pages").exists()


@pytest.fixture(scope="module")
def packed(scan, tmp_path_factory):
    out = tmp_path_factory.mktemp("packed") / "out"
    options = [
        "--preset",
        "draft",
        "--executor",
        "serial",
        "--no-render",
        "--training-splats",
        "256",
        "--iterations",
        "1",
    ]
    assert main(["compress", str(scan), "--out", str(out), *options]) == 0
    return next(out.glob("*.splatpress"))


def test_path__is_recorded_from_photographs_from_its_own_file_and_of_the_paper(packed, tmp_path, capsys):
    first, again, walk = (tmp_path / name for name in ("a.json", "b.json", "walk.json"))
    assert main(["path", "record", str(packed), "--out", str(first), "--seconds", "1"]) == 0
    assert main(["path", "record", str(packed), "--out", str(again), "--seconds", "2", "--through", str(first)]) == 0
    assert main(["path", "record", str(packed), "--out", str(walk), "--through", "forward"]) == 0
    assert [len(read_path(p).poses) for p in (first, again, walk)] == [90, 180, 360]
    assert main(["path", "record", str(packed), "--out", str(walk), "--through", "nowhere"]) == 1


def test_fly__makes_table_1_in_its_form_and_the_same_twice(packed, monkeypatch, capsys):
    monkeypatch.setattr(simulate, "SCREEN", Screen(144, 156, 72.0))
    monkeypatch.setattr(paths, "SECONDS", 0.2)
    outputs = []
    for _ in range(2):
        assert main(["fly", str(packed), "--table", "--json", "--magnified", "8"]) == 0
        outputs.append(capsys.readouterr().out)
    assert outputs[0] == outputs[1]
    found = json.loads(outputs[0])
    assert set(found["misses"]) == {"nothing", "bias", "frustum", "combined"}
    assert all(set(row) == set(paths.NAMES) for row in found["misses"].values())
    assert len(found["rows"]) == 4 * 4 * 2 * 3 and max(r["misses"]["wanted"] for r in found["rows"]) > 0
    assert "8 pages a frame, pool of 2500, policy paper" in as_text(found)


def test_fly__a_file_without_photographs_is_refused(tmp_path, capsys):
    out = tmp_path / "out"
    scan = point_scan(tmp_path / "points.ply", 300)
    assert main(["compress", str(scan), "--out", str(out), "--executor", "serial", "--no-render"]) == 0
    assert main(["fly", str(next(out.glob("*.splatpress"))), "--table"]) == 3
    assert "no photograph" in capsys.readouterr().err
