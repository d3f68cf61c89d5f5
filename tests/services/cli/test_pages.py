"""The verb `pages` on a small made scene."""

import json

import pytest

from services.cli.main import main
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
