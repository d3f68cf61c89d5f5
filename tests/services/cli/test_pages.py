"""The verbs `pages`, `path` and `fly` on a small made scene."""

import json
from dataclasses import replace

import pytest

from renderer.residency import paths, simulate
from renderer.residency.paths import read_path
from renderer.residency.places import Screen
from services.cli.main import main
from services.processes.pages.fly import warnings_of
from services.processes.pages.table import as_text
from storage.packed.packed import PackedFile
from storage.pages.file import PageFile, scan_digest
from tests.effects_scans import PARAMS, wall_scan
from tests.pipeline.readers.workspace import DISTANCE
from tests.services.scans import photo_scan, point_scan


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
    options = "--preset draft --executor serial --no-render --training-splats 256 --iterations 1 --effects exposure=on --pages --page-codec webp --geometry quadrics"
    assert main(["compress", str(scan), "--out", str(out), "--work", str(out.parent / "work"), *options.split()]) == 0
    return next(out.glob("*.splatpress"))


def test_compress__pages_lie_beside_the_packed_file_as_pages_of_its_work_folder_are(packed, tmp_path):
    pages, report = packed.with_suffix(".pages"), json.loads((packed.parent / "report.json").read_text())
    assert run(packed.parent.parent / "work", "--out", tmp_path / "again.pages", "--codec", "webp") == 0
    assert pages.read_bytes() == (tmp_path / "again.pages").read_bytes()
    row = next(row for row in report["effects"] if row["effect"] == "pages")
    assert row["enabled"] and report["pages"]["bytes"] == pages.stat().st_size
    width_px = 2 * report["radius"] * PARAMS[0] / DISTANCE  # of splats straight ahead
    assert row["measure"] == pytest.approx(width_px / 32, rel=0.1) and row["threshold"] == 0.5
    with PageFile(pages) as file, PackedFile(packed) as opened:
        assert (
            file.header.one_light and file.header.codec == "webp" and report["pages"]["n_pages"] == file.layout.n_pages
        )
        assert file.header.scan == scan_digest(opened.load().header.cameras)
    assert "as webp" in (packed.parent / "report.html").read_text()


def test_fly__warns_where_atoms_are_in_one_light_and_pages_are_not(scan, packed, tmp_path):
    with PackedFile(packed) as opened:
        header = opened.load().header
    for source, one_light in ((scan, False), (packed.parent.parent / "work", True)):
        pages = tmp_path / f"{one_light}.pages"
        assert run(source, "--out", pages) == 0
        with PageFile(pages) as file:
            assert file.header.one_light == one_light
            assert bool(warnings_of(file, header)) != one_light
            assert not warnings_of(file, replace(header, effects={}))


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
        assert main(["fly", str(packed), "--table", "--json", "--magnified", "8", "--cold-start"]) == 0
        outputs.append(capsys.readouterr().out)
    assert outputs[0] == outputs[1]
    found = json.loads(outputs[0])
    assert set(found["misses"]) == {"nothing", "bias", "frustum", "combined"}
    assert all(set(row) == set(paths.NAMES) for row in found["misses"].values())
    assert (
        len(found["rows"]) == 2 * 4 * 4 * 2 * 3
        and set(found["misses_by_pages"]["bias"]) == set(paths.NAMES)
        and max(r["misses"]["wanted"] for r in found["rows"]) > 0
    )
    assert "8 pages a frame, pool of 2500, policy paper, cold" in as_text(found)
    cold = [[r["misses"]["pixels"] for r in found["rows"] if r["cold"] == start] for start in (True, False)]
    assert sum(cold[0]) > sum(cold[1]), "who comes in at once misses the first view"


def test_fly__a_file_without_photographs_is_refused(tmp_path, capsys):
    out = tmp_path / "out"
    scan = point_scan(tmp_path / "points.ply", 300)
    assert main(["compress", str(scan), "--out", str(out), "--executor", "serial", "--no-render"]) == 0
    assert main(["fly", str(next(out.glob("*.splatpress"))), "--table"]) == 3
    assert "no photograph" in capsys.readouterr().err


def test_fly__draws_a_path_and_says_what_was_missed(scan, packed, tmp_path, renderer, capsys):
    pages, path, out = tmp_path / "wall.pages", tmp_path / "path.json", tmp_path / "flight"
    assert run(scan, "--out", pages, "--page-size", 64) == 0
    assert main(["path", "record", str(packed), "--out", str(path), "--seconds", "1"]) == 0
    given = ["fly", str(packed), "--path", str(path), "--size", "96x80", "--every", "30", "--pool-mib", "4", "--json"]
    assert main([*given, "--pages", str(pages), "--out", str(out)]) == 0
    told = capsys.readouterr()
    assert "warning: wall.pages: pages of photographs as they were taken" in told.err
    found = json.loads(told.out.splitlines()[-1])
    assert found == json.loads((out / "fly.json").read_text())
    assert len(found["frames"]) == 3 == len(list(out.glob("frame_*.png")))
    assert (
        found["loaded"] >= 0
        and found["wanted_pages"] > 0
        and set(found["pass_ms"]) >= {"cull", "attribute", "feedback", "predict", "upload"}
    )
    data = pages.read_bytes()
    for name, harmed in (("cut", data[:-1]), ("not", b"nothing"), ("table", data[:900] + b"?" + data[901:])):
        (tmp_path / f"{name}.pages").write_bytes(harmed)
        assert main([*given, "--pages", str(tmp_path / f"{name}.pages"), "--out", str(tmp_path / "no")]) == 3
    assert main([*given, "--pages", str(pages), "--out", str(out)]) == 1, "there already"
    assert not (tmp_path / "no").exists()


def test_fly__pages_of_another_scan_are_refused(packed, tmp_path, renderer, capsys):
    other, pages, path = (
        photo_scan(tmp_path / "other", 20, n_cameras=2),
        tmp_path / "other.pages",
        tmp_path / "path.json",
    )
    assert run(other, "--out", pages) == 0
    assert main(["path", "record", str(packed), "--out", str(path), "--seconds", "0.1"]) == 0
    code = main(["fly", str(packed), "--pages", str(pages), "--path", str(path), "--out", str(tmp_path / "no")])
    assert code == 3 and "pages of another scan" in capsys.readouterr().err
