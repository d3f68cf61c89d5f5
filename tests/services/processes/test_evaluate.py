"""The paper's evaluation on a small scan: every figure of a row agrees with what it is made of."""

from __future__ import annotations

import json

import numpy as np
import pytest
from msgspec import to_builtins

from pipeline.execution.executors import SerialExecutor
from pipeline.planning.settings import settings_for
from pipeline.stages.pages.coded import PageForm
from renderer.evaluate import close_ups
from services.cli.main import main
from services.processes import evaluate as evaluation
from services.processes import evaluated_rows
from services.processes.compress import compress
from services.processes.evaluate import evaluate
from storage.errors import InvalidScan
from tests.pipeline.execution.test_stage import Heard
from tests.renderer.report.test_report import Elements
from tests.services.processes.published_schemas import misfits
from tests.services.scans import photo_scan, point_scan

SETTINGS = settings_for("draft", dictionary="own", target_psnr_db=32.0, training_splats=1500, iterations=2)
ROWS = ("lod0", "lod0-bc7", "lod1", "lod1-bc1", "d8w4", "average", "per-splat", "jpeg")
KEYS = {
    "name",
    "coder",
    "texture_bytes",
    "geometry_bytes",
    "bytes_per_splat",
    "texture_psnr_db",
    "visible_psnr_db",
    "seconds",
}


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    return photo_scan(tmp_path_factory.mktemp("scan") / "wavy plane", n_side=32)


@pytest.fixture(scope="module")
def made(scan, tmp_path_factory, renderer):
    out = tmp_path_factory.mktemp("evaluated") / "out"
    document = to_builtins(evaluate(scan, out, SETTINGS, SerialExecutor(), Heard(), rows=ROWS, hold_out=3))
    return out, document, {row["key"].removesuffix("-paper"): row for row in document["rows"]}


def test_evaluate__leaves_the_document_the_page_and_its_pictures(made):
    out, document, _ = made
    assert json.loads((out / "evaluate.json").read_text())["rows"] == json.loads(json.dumps(document["rows"]))
    assert not misfits(out / "evaluate.json")
    assert sorted(p.name for p in out.iterdir()) == ["close-ups", "evaluate.html", "evaluate.json", "held-out"]
    assert [p.name for p in out.parent.iterdir()] == ["out"]


def test_evaluate__every_row_has_its_keys_and_its_bytes_add_up(made):
    _, document, rows = made
    assert set(ROWS) <= rows.keys() and all(row.keys() >= KEYS for row in rows.values())
    for row in rows.values():
        assert row["bytes_per_splat"] == pytest.approx(
            (row["texture_bytes"] + row["geometry_bytes"]) / document["splats"]
        )
        assert row["seconds"] > 0
    assert len({row["geometry_bytes"] for row in rows.values()}) == 1
    n_pixels = 3 * 320 * 240 * (1 + 1 / 4 + 1 / 16 + 1 / 64 + 1 / 256)
    assert (
        rows["lod0"]["texture_bytes"]
        == pytest.approx(3 * n_pixels)
        == pytest.approx(4 * rows["lod1"]["texture_bytes"], rel=0.01)
    )
    assert rows["lod0-bc7"]["texture_bytes"] == pytest.approx(n_pixels, rel=0.01)
    assert rows["per-splat"]["texture_bytes"] == 4092 * document["splats"]


def test_evaluate__what_keeps_more_loses_less(made):
    rows = made[2]
    assert rows["lod0"]["texture_psnr_db"] is None and rows["per-splat"]["texture_psnr_db"] is None
    psnr = [rows[key]["texture_psnr_db"] for key in ("lod0-bc7", "lod1", "lod1-bc1")]
    assert psnr == sorted(psnr, reverse=True) and psnr[0] > 40
    assert rows["average"]["texture_psnr_db"] < rows["d8w4"]["texture_psnr_db"]


def test_evaluate__pictures_of_what_is_drawn_are_compared_with_the_photographs(made):
    found = {key: row["picture_psnr_db"] for key, row in made[2].items()}
    assert found["jpeg"] is None and found["per-splat"] is None
    drawn = {key: psnr for key, psnr in found.items() if psnr is not None}
    assert {"lod0", "lod0-bc7", "lod1", "lod1-bc1", "d8w4", "average"} <= drawn.keys()
    assert all(10 < psnr < 60 for psnr in drawn.values()) and drawn["average"] != drawn["d8w4"]
    assert abs(drawn["lod0"] - drawn["lod0-bc7"]) < 0.5


def test_evaluate__our_rows_are_what_compress_makes(made, scan, tmp_path):
    report = compress(
        scan,
        tmp_path / "out",
        settings_for(
            "draft",
            **{k: getattr(SETTINGS, k) for k in ("dictionary", "target_psnr_db", "training_splats", "iterations")},
        ),
        SerialExecutor(),
        Heard(),
        render=False,
    )
    ours = [row for row in made[1]["rows"] if row["kind"] == "ours" and row["n_dictionary"]]
    found = [(row["texture_psnr_db"], row["bytes_per_splat"]) for row in ours]
    assert (report["quality"]["texture_psnr_db"], report["sizes"]["bytes_per_splat"]) in found


def test_evaluate__close_ups_show_every_variant_and_passes_are_timed(made):
    out, document, _ = made
    assert [row["why"] for row in document["close_ups"]][::5] == ["around the best splat", "around the worst splat"]
    for row in document["close_ups"]:
        assert len(row["pictures"]) >= 6 and all((out / path).is_file() for path in row["pictures"].values())
        figures = row["figures"]
        assert (
            figures["photos LOD 0"] is None
            and figures["photos LOD 0 BC7"]["psnr_db"] > figures["photos LOD 1 BC1"]["psnr_db"]
        )
    assert all(set(row["seconds"]) == {"cull", "visibility", "attribute", "resolve"} for row in document["passes"])
    assert {"photos LOD 0", "photos LOD 1"} < {row["name"] for row in document["passes"]}


def test_evaluate__photographs_that_exceed_the_pool_give_the_figures_of_those_that_fit(scan, tmp_path, monkeypatch):
    """120 kB of pages at a time, of 900 kB of photographs; figures to 0.05 dB."""
    monkeypatch.setattr(evaluation, "PAGED", PageForm("png", 32))
    monkeypatch.setattr(close_ups, "TIMED_SIDE_PX", 64)
    monkeypatch.setattr(close_ups, "ROUNDS", 1)
    found = {}
    for name, pool_bytes in (("fits", 1 << 29), ("paged", 25 * 3 * 40**2)):
        heard = Heard()
        evaluate(
            scan, tmp_path / name, SETTINGS, SerialExecutor(), heard, rows=("average", "lod0", "lod1"), work=tmp_path / "work",
            pool_bytes=pool_bytes,
        )  # fmt: skip
        found[name] = json.loads((tmp_path / name / "evaluate.json").read_text())
        assert (("begin", "photo-pages", 3) in heard.events) == (name == "paged")
    assert not found["paged"]["failed"] and len(found["paged"]["close_ups"]) == 6
    for fits, paged in zip(found["fits"]["close_ups"], found["paged"]["close_ups"], strict=True):
        for variant in ("photos LOD 1", "average"):
            one, other = (next(f for n, f in row["figures"].items() if n.startswith(variant)) for row in (fits, paged))
            assert other["psnr_db"] == pytest.approx(one["psnr_db"], abs=0.05)


def test_evaluate__held_out_photographs_texture_nothing_and_are_compared_with(made, scan, tmp_path):
    from services.flow.prepare import prepare
    from services.flow.run import Run
    from storage.work import arrays

    held = made[1]["held_out"]
    assert [view["camera"] for view in held["views"]] == ["0000.png"]
    view = held["views"][0]
    assert 0.3 < view["coverage"] <= 1 and view["psnr_db"] > 15 and 0 < view["flip"] < 0.5 and 0 < view["ssim"] < 1
    run = Run(tmp_path / "work", SerialExecutor(), Heard())
    cameras = [arrays.read(prepare(run, scan, None, held_out=held).splats.folder, "camera") for held in ((), (0,))]
    assert (cameras[0] == 0).any() and not (cameras[1] == 0).any()


def test_evaluate__atoms_grow_with_the_target(made):
    atoms = made[1]["atoms"]
    mean = [np.dot(h, range(len(h))) / sum(h) for h in atoms["histograms"]]
    assert mean == sorted(mean) and mean[0] < mean[-1] and all(sum(h) == atoms["n_splats"] for h in atoms["histograms"])


def test_evaluate__the_page_asks_no_other_host(made):
    elements = Elements((made[0] / "evaluate.html").read_text())
    asked = [
        v
        for _, attributes in elements.tags
        for k, v in attributes.items()
        if k in ("src", "href") and not v.startswith("data:")
    ]
    assert not asked and not {tag for tag, _ in elements.tags} & {"link", "iframe", "base"}
    assert not {"nan", "None", "inf"} & set("".join(elements.text).split())


def test_evaluate__a_scan_without_photographs_is_refused(tmp_path):
    with pytest.raises(InvalidScan, match="allowed: a scan with photographs"):
        evaluate(point_scan(tmp_path / "ball.ply"), tmp_path / "out", SETTINGS, SerialExecutor(), Heard())
    assert [p.name for p in tmp_path.iterdir()] == ["ball.ply"]


def test_evaluate__unknown_rows_are_named(scan, tmp_path, capsys):
    assert main(["evaluate", str(scan), "--out", str(tmp_path / "o"), "--rows", "d8w4,bc9"]) == 1
    assert "--rows has 'bc9'; allowed: lod0, lod0-bc7" in capsys.readouterr().err


FEW = {"rows": ("d16w8", "average"), "render": False}


def test_evaluate__figure_9_is_of_the_published_coder_where_dictionaries_are_as_large(scan, tmp_path):
    document = to_builtins(evaluate(scan, tmp_path / "out", SETTINGS, SerialExecutor(), Heard(), **FEW))
    sizes = {row["key"]: row["n_dictionary"] for row in document["rows"] if row["n_dictionary"]}
    # Both as many as the patches learned from allow: by default a quarter of these is held back, to choose by.
    assert 0.7 * sizes["d16w8-paper"] <= sizes["d16w8-default"] <= sizes["d16w8-paper"]
    assert document["atoms"]["row"] == "d16w8-paper" and len(document["atoms"]["histograms"]) == len(
        document["atoms"]["targets_db"]
    )
    assert not document["failed"] and document["complete"]


def test_evaluate__what_fails_is_named_and_takes_nothing_with_it(scan, tmp_path, monkeypatch, capsys):
    def fails(*arguments):
        raise ValueError("patches (1024, 3072) and dictionary (40808, 192)")

    monkeypatch.setattr("services.processes.evaluate._figure_9", fails)
    monkeypatch.setattr(
        "services.processes.evaluate.photo_row",
        lambda e, key, *how: fails() if key == "lod1-bc1" else evaluated_rows.photo_row(e, key, *how),
    )
    told = [
        "evaluate",
        str(scan),
        "--out",
        str(tmp_path / "out"),
        "--rows",
        "average,lod1,lod1-bc1,d8w4",
        "--no-render",
        "--preset",
        "draft",
        "--iterations",
        "1",
        "--training-splats",
        "1500",
        "--workers",
        "1",
    ]
    assert main(told) == 4
    document = json.loads((tmp_path / "out/evaluate.json").read_text())
    assert [row["key"] for row in document["rows"]] == ["lod1", "d8w4-default", "d8w4-paper", "average"]
    assert [(f["name"], f["class"]) for f in document["failed"]] == [("lod1-bc1", "internal"), ("Figure 9", "internal")]
    assert document["atoms"] is None and document["complete"]
    page, told = (tmp_path / "out/evaluate.html").read_text(), capsys.readouterr().err
    for text in (page, told):
        assert "Figure 9" in text and "patches (1024, 3072) and dictionary (40808, 192)" in text


def test_evaluate__rows_are_written_as_they_come(scan, tmp_path, monkeypatch):
    out, seen = tmp_path / "out", []

    def interrupted(e, key, *arguments):
        seen.append(json.loads((out / "evaluate.json").read_text()))
        if key == "lod1":
            raise KeyboardInterrupt
        return evaluated_rows.photo_row(e, key, *arguments)

    monkeypatch.setattr("services.processes.evaluate.photo_row", interrupted)
    with pytest.raises(KeyboardInterrupt):
        evaluate(scan, out, SETTINGS, SerialExecutor(), Heard(), rows=("average", "lod0", "lod1"), render=False)
    assert [[row["key"] for row in document["rows"]] for document in seen] == [["average"], ["lod0", "average"]]
    assert seen[0]["rows"][0]["factor_total"] is None and seen[1]["rows"][1]["factor_total"] > 1
    left = json.loads((out / "evaluate.json").read_text())
    assert not left["complete"] and [row["key"] for row in left["rows"]] == ["lod0", "average"]
    assert "still under way" in (out / "evaluate.html").read_text()
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_evaluate__holding_out_every_photograph_is_refused_before_anything_is_measured(scan, tmp_path):
    with pytest.raises(InvalidScan, match="3 photographs, each of them held out"):
        evaluate(scan, tmp_path / "out", SETTINGS, SerialExecutor(), Heard(), rows=("average",), hold_out=1)
    assert not (tmp_path / "out").exists()
