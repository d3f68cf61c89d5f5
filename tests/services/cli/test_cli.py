"""The command line: exit codes, messages, and what ends up where."""

from __future__ import annotations

import json

import numpy as np
import pytest

from services.cli.main import main
from storage.errors import ResourceExhausted
from storage.packed.schema import MAX_ATOMS
from tests.services.processes.published_schemas import misfits
from tests.services.scans import photo_scan, point_scan


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    return photo_scan(tmp_path_factory.mktemp("scan") / "plane", n_side=40)


@pytest.fixture(scope="module")
def compressed(scan, tmp_path_factory, request):
    out = tmp_path_factory.mktemp("made") / "out"
    assert (
        main(["compress", str(scan), "--out", str(out), "--preset", "draft", "--executor", "serial", "--no-render"])
        == 0
    )
    return out


def run(capsys, *arguments: str) -> tuple[int, str, str]:
    try:
        code = main([str(a) for a in arguments])
    except SystemExit as stop:
        code = stop.code
    return code, *capsys.readouterr()


def test_cli__compress_prints_where_its_outputs_are(scan, tmp_path, capsys):
    code, out, err = run(capsys, "compress", scan, "--out", tmp_path / "o", "--executor", "serial", "--no-render")
    assert code == 0 and str(tmp_path / "o" / "report.html") in out and "texture PSNR" in out
    assert "resample" in err and "splats/s" in err


def test_cli__json_is_the_last_line_of_stdout(scan, tmp_path, capsys):
    code, out, _ = run(
        capsys, "compress", scan, "--out", tmp_path / "o", "--executor", "serial", "--no-render", "--json"
    )
    assert code == 0 and json.loads(out.splitlines()[-1])["splats"] == 1600


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (
            ["compress", "{scan}", "--out", "{tmp}/o", "--dictionary-bits", "7"],
            1,
            "--dictionary-bits is 7; allowed: auto, 8",
        ),
        (
            ["compress", "{scan}", "--out", "{tmp}/o", "--preset", "fast"],
            1,
            "preset is 'fast'; allowed: draft, balanced, high",
        ),
        (["compress", "{scan}", "--out", "{tmp}/o", "--radius", "-1"], 1, "radius is -1; allowed: above 0"),
        (["compress", "{scan}", "--out", "{tmp}/o", "--workers", "0"], 1, "--workers"),
        (["compress", "{scan}"], 1, "--out"),
        (["compress", "{scan}", "--out", "{tmp}"], 1, "is not empty; choose another, or say --overwrite"),
        (["compress", "{tmp}/nothing", "--out", "{tmp}/o"], 2, "nothing: no such file or folder"),
        (["compress", "{tmp}/empty.ply", "--out", "{tmp}/o"], 3, "empty.ply"),
        (["compress", "{tmp}/a.obj", "--out", "{tmp}/o"], 5, ".obj"),
        (["inspect", "{tmp}/a.obj"], 5, "allowed: a COLMAP dense workspace"),
        (["render", "{tmp}/a.obj", "--orbit", "1", "--out", "{tmp}/o"], 3, "a.obj"),
        (["render", "{packed}", "--orbit", "1", "--size", "huge", "--out", "{tmp}/o"], 1, "'huge' is not WIDTHxHEIGHT"),
        (["render", "{packed}", "--orbit", "0", "--out", "{tmp}/o"], 1, "--orbit"),
        (
            ["render", "{packed}", "--orbit", "1", "--pool-mib", "9", "--out", "{tmp}/o"],
            3,
            "one level, drawn through a pool",
        ),
        (
            ["render", "{packed}", "--orbit", "1", "--atoms", "99", "--out", "{tmp}/o"],
            1,
            "atoms is 99; allowed: whole numbers, 0 to ",
        ),
        (
            ["render", "{packed}", "--orbit", "1", "--precision", "24", "--out", "{tmp}/o"],
            1,
            "precision is 24; allowed: auto, 16, 32",
        ),
        (["render", "{packed}", "--camera", "x.png", "--out", "{tmp}/o"], 3, "no camera 'x.png'; allowed: 0000.png"),
    ],
)
def test_cli__wrong_input_has_its_exit_code_and_one_clear_line(
    scan, compressed, tmp_path, capsys, arguments, code, words
):
    (tmp_path / "empty.ply").write_bytes(b"")
    (tmp_path / "a.obj").write_text("v 0 0 0\n")
    names = {"scan": scan, "tmp": tmp_path, "packed": compressed / "plane.splatpress"}
    found, out, err = run(capsys, *(a.format(**names) for a in arguments))
    assert found == code and words in err and "Traceback" not in err
    assert not (tmp_path / "o").exists() or not any((tmp_path / "o").iterdir())


def test_cli__a_quality_gate_missed_exits_with_7_and_keeps_the_output(scan, tmp_path, capsys):
    code, _, err = run(
        capsys,
        "compress",
        scan,
        "--out",
        tmp_path / "o",
        "--preset",
        "draft",
        "--executor",
        "serial",
        "--no-render",
        "--require-psnr-db",
        "79",
    )
    assert (
        code == 7 and "quality gate missed: texture PSNR is" in err and (tmp_path / "o" / "plane.splatpress").exists()
    )


def test_cli__overwrite_replaces_what_was_there(scan, tmp_path, capsys):
    out = tmp_path / "o"
    out.mkdir()
    (out / "old.txt").write_text("old")
    arguments = (
        "compress",
        scan,
        "--out",
        out,
        "--preset",
        "draft",
        "--executor",
        "serial",
        "--no-render",
        "--overwrite",
    )
    assert run(capsys, *arguments)[0] == 0
    assert sorted(p.name for p in out.iterdir()) == ["plane.splatpress", "report.html", "report.json"]


def test_cli__inspect_tells_scan_and_packed_file_apart(scan, compressed, capsys):
    code, out, _ = run(capsys, "inspect", scan, "--json")
    found = json.loads(out)
    assert code == 0 and found["format"] == "colmap" and found["points"] == 1600 and found["cameras"]["count"] == 3
    code, out, _ = run(capsys, "inspect", compressed / "plane.splatpress", "--json")
    found = json.loads(out)
    assert code == 0 and found["kind"] == "packed" and found["n_splats"] == 1600
    code, out, _ = run(capsys, "inspect", scan)
    assert code == 0 and "points: 1600" in out and "bounds: unknown" in out and "None" not in out
    code, out, _ = run(capsys, "inspect", compressed / "plane.splatpress")
    assert code == 0 and "budget_bytes: none" in out and "None" not in out


def test_cli__render_writes_the_pictures_it_names(compressed, tmp_path, capsys, renderer):
    packed = compressed / "plane.splatpress"
    code, out, _ = run(capsys, "render", packed, "--camera", "0001.png", "--out", tmp_path / "p")
    assert code == 0 and out.split() == [str(tmp_path / "p" / "0001.png")]
    code, out, _ = run(
        capsys, "render", packed, "--orbit", "3", "--size", "80x60", "--max-atoms", "0", "--out", tmp_path / "q"
    )
    assert code == 0 and len(out.split()) == 3 == len(list((tmp_path / "q").iterdir()))


@pytest.mark.parametrize(
    ("arguments", "n_atoms", "accumulation", "watched", "detail"),
    [
        ([], MAX_ATOMS, "RGBA16F", True, (1.0, None)),
        (["--atoms", "2", "--precision", "32", "--detail", "0"], 2, "RGBA32F", False, (0.0, None)),
        (["--precision", "16", "--most-splats", "9000"], MAX_ATOMS, "RGBA16F", False, (1.0, 9000)),
    ],
)
def test_cli__render_draws_as_many_atoms_and_splats_as_precisely_as_asked(
    compressed, tmp_path, capsys, renderer, monkeypatch, arguments, n_atoms, accumulation, watched, detail
):
    from renderer.splats.detail import Detail
    from renderer.splats.renderer import Renderer

    drawn, render = [], Renderer.render

    def noted(self, gpu_scene, view, most, light, asked):
        picture = render(self, gpu_scene, view, most, light, asked)
        drawn.append((most, picture.accumulation, gpu_scene.watched, asked))
        return picture

    monkeypatch.setattr(Renderer, "render", noted)
    code, _, _ = run(
        capsys,
        "render",
        compressed / "plane.splatpress",
        "--orbit",
        "1",
        "--size",
        "80x60",
        *arguments,
        "--out",
        tmp_path / "p",
    )
    assert code == 0 and drawn == [(n_atoms, accumulation, watched, Detail(*detail))]


def test_cli__points_alone_go_through_with_previews(tmp_path, capsys, renderer):
    scan = point_scan(tmp_path / "ball.ply")
    code, out, _ = run(capsys, "compress", scan, "--out", tmp_path / "o", "--executor", "serial")
    assert code == 0 and "previews" in out and len(list((tmp_path / "o" / "previews").glob("*.png"))) == 4
    assert not misfits(tmp_path / "o" / "report.json")


def test_cli__report_has_views_beside_the_photographs(scan, compressed, tmp_path, capsys, renderer):
    code, out, _ = run(
        capsys,
        "report",
        compressed / "plane.splatpress",
        "--scan",
        scan,
        "--out",
        tmp_path / "r",
        "--executor",
        "serial",
        "--json",
    )
    made = json.loads(out.splitlines()[-1])
    views = made["quality"]["views"]
    assert code == 0 and len(views) == 3 and (tmp_path / "r" / "report.html").exists()
    assert all(v["psnr_vs_baseline_db"] > 25 and v["ssim_vs_baseline"] > 0.8 for v in views)
    assert all(abs(v["psnr_vs_photo_db"] - v["baseline_psnr_vs_photo_db"]) < 3 for v in views)


def test_cli__a_mistake_of_ours_does_not_look_like_wrong_arguments(scan, tmp_path, capsys, monkeypatch):
    def fails(*_, **__):
        raise IndexError("ours")

    monkeypatch.setattr("services.processes.compress.compress", fails)
    code, _, err = run(capsys, "compress", scan, "--out", tmp_path / "o", "--executor", "serial")
    assert code == 4 and "IndexError: ours" in err and "please report" in err


def test_cli__effects_says_what_a_scan_calls_for(scan, capsys):
    code, out, _ = run(capsys, "effects", scan, "--json", "--executor", "serial", "--effect", "depth_margin=on")
    row = next(row for row in json.loads(out.splitlines()[-1]) if row["effect"] == "depth_margin")
    assert code == 0 and row["enabled"] and row["measure"] >= 0 and row["reason"] == "asked to be on"
    code, out, _ = run(capsys, "effects", scan, "--executor", "serial", "--effect", "all=off")
    assert code == 0 and all("asked to be off" in line for line in out.splitlines() if line)
    code, _, err = run(capsys, "effects", scan, "--effect", "fog=on")
    assert code == 1 and "allowed: " in err


def test_cli__render_lights_a_file_that_was_not_made_for_it(compressed, tmp_path, capsys, renderer):
    pictures = []
    for name, light in (("plain", ()), ("lit", ("--light", "1,1,0.2"))):
        assert (
            run(
                capsys,
                "render",
                compressed / "plane.splatpress",
                "--orbit",
                "1",
                "--size",
                "80x60",
                "--out",
                tmp_path / name,
                *light,
            )[0]
            == 0
        )
        pictures.append(next((tmp_path / name).iterdir()).read_bytes())
    assert pictures[0] != pictures[1]
    with pytest.raises(SystemExit):
        main(["render", "x", "--orbit", "1", "--out", "y", "--light", "0,0,0"])


def test_cli__what_takes_a_second_is_looked_at_before_workers_start(scan, tmp_path, capsys, monkeypatch):
    def fails():
        raise ResourceExhausted("OpenGL", "no headless context", "OpenGL 4.5 on EGL", "install libegl1")

    def starts(options):
        raise AssertionError("workers started")

    monkeypatch.setattr("renderer.splats.context.gl_context", fails)
    monkeypatch.setattr("services.cli.commands.compress.executor_for", starts)
    code, _, err = run(capsys, "compress", scan, "--out", tmp_path / "o")
    assert code == 2 and "install libegl1; or go without pictures: --no-render" in err
    (tmp_path / "Wände 2.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n")
    code, _, err = run(capsys, "compress", tmp_path / "Wände 2.ply", "--out", tmp_path / "o", "--no-render")
    assert code == 3 and "Wände 2.ply" in err and len(err.splitlines()) == 1
    assert not (tmp_path / "o").exists()


def test_cli__pictures_are_transparent_unless_a_background_is_asked_for(compressed, tmp_path, capsys):
    from PIL import Image

    file = next(compressed.glob("*.splatpress"))
    size = ["--size", "80x60"]
    assert run(capsys, "render", str(file), "--orbit", "1", *size, "--out", str(tmp_path / "clear"))[0] == 0
    with Image.open(next((tmp_path / "clear").glob("*.png"))) as picture:
        assert picture.mode == "RGBA"
        alpha = np.asarray(picture)[..., 3]
        assert (alpha == 0).any() and (alpha == 255).any() and ((alpha > 0) & (alpha < 255)).any()  # soft rims
    turned = ["--turntable", "3", "--background", "#ffffff", *size, "--out", str(tmp_path / "turned")]
    assert run(capsys, "render", str(file), *turned)[0] == 0
    assert len(list((tmp_path / "turned").glob("*.png"))) == 3
    with Image.open(tmp_path / "turned" / "turntable.webp") as animation:
        assert animation.n_frames == 3
    with Image.open(next((tmp_path / "turned").glob("*.png"))) as picture:
        assert picture.mode == "RGB" and (np.asarray(picture) == 255).all(axis=2).any()
    code, _, err = run(capsys, "render", str(file), "--orbit", "1", "--background", "white", "--out", str(tmp_path))
    assert code == 1 and "'white' is no colour; allowed: #RRGGBB" in err


def test_cli__coverage_has_holes_and_overdraw_view_by_view(compressed, tmp_path, capsys):
    file = next(compressed.glob("*.splatpress"))
    code, out, _ = run(capsys, "coverage", str(file), "--json")
    found = json.loads(out.splitlines()[-1])
    assert code == 0 and len(found["surface"]) == 3 and len(found["outline"]) == 4
    assert all(row["holes"] < 0.1 and row["overdraw"] < 1.5 for row in found["surface"])
    assert all(row["unscanned"] + row["uncovered"] == pytest.approx(row["holes"]) for row in found["outline"])
    assert "overdraw" in run(capsys, "coverage", str(file), "--pictures", tmp_path / "p")[1]
    assert [p.name for p in sorted((tmp_path / "p").iterdir())] == [f"orbit_{i:03d}.png" for i in range(4)]


def test_cli__a_gate_without_a_measure_is_missed(tmp_path, capsys):
    ball = point_scan(tmp_path / "ball.ply")
    arguments = ("--executor", "serial", "--no-render", "--preset", "draft", "--require-psnr-db", "30")
    code, out, err = run(capsys, "compress", ball, "--out", tmp_path / "o", *arguments)
    assert code == 7 and "no texture PSNR is measured without photographs" in err
    assert f"packed           {tmp_path / 'o' / 'ball.splatpress'}" in out and "splatpress view" in out


def test_cli__check_always_says_something(scan, capsys):
    code, out, _ = run(capsys, "check", scan)
    assert code == 0 and out.splitlines()[-1] == "ok: compress takes it"
