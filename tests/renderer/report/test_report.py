"""The report as data, and as a page."""

import json
import os
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import msgspec
import numpy as np
import pytest

from renderer.files import strict
from renderer.pictures import jpeg_within, save_picture
from renderer.report.dictionary_picture import GAP_PX, atom_uses, dictionary_picture
from renderer.report.document import RunRecord, ViewMeasured
from renderer.report.report import as_json, build_report, write_report
from renderer.report.report_page import ALL_PICTURES_BYTES, page_of, write_page
from renderer.report.report_plots import PART_COLORS
from renderer.report.report_words import geometry_figures, parts_of
from storage.packed.packed import PackedFile
from storage.packed.schema import PATCH_SIZE
from tests.scenes import Settings, Splats, build_scene, camera_looking, random_dictionary, sheet

KEYS = {
    "": {"scan", "splats", "sizes", "quality", "atoms", "learning", "stages", "settings", "warnings"},
    "sizes": {
        "geometry_bytes",
        "codes_bytes",
        "colors_bytes",
        "dictionary_bytes",
        "gpu_bytes",
        "file_bytes",
        "bytes_per_splat",
        "source_texture_bytes",
        "compression_factor_total",
        "compression_factor_texture",
    },
    "quality": {"texture_psnr_db", "visible_psnr_db", "resampling_psnr_db", "views"},
    "atoms": {"histogram", "mean"},
}
HOSTILE = "</script><script src=\"http://x.test/\">alert('$$\\int$$')</script><img src=x>"
N = 500
MAPS = Path(__file__).parents[2] / "golden" / "maps.splatpress"


def tiny(n_photos=2, n_dictionary=20, name="photo"):
    rng = np.random.default_rng(7)
    cameras = tuple(camera_looking((i, -3, 0), (0, 0, 0), (200, 100), name=f"{name}{i}") for i in range(n_photos))
    splats = Splats(
        rng.uniform(-1, 1, (N, 3)),
        np.tile([0.0, 0, 1], (N, 1)),
        n_atoms=rng.integers(0, 7, N) if n_dictionary else None,
        atom=rng.integers(0, max(1, n_dictionary), (N, 8)),
        weight=rng.integers(0, 16, (N, 8)),
        camera=np.zeros(N) if n_photos else None,
    )
    dictionary = random_dictionary(rng, n_dictionary, bits=16) if n_dictionary else None
    return build_scene(splats, Settings(cameras=cameras), dictionary)


def full_record():
    return {
        "scan": {
            "name": HOSTILE,
            "format": "colmap",
            "n_points": 600,
            "unit": "metre",
            "n_cameras": 2,
            "warnings": [HOSTILE],
        },
        "quality": {
            "texture_psnr_db": 40.5,
            "visible_psnr_db": 42.0,
            "resampling_psnr_db": 52.5,
            "geometry": {
                "mean_position_error": 1e-5,
                "mean_position_error_in_radii": 0.01,
                "mean_normal_error_degrees": 0.3,
            },
        },
        "learning": [{"seconds": 1.0, "psnr_db": 38.0, "replaced_atoms": 3}, {"seconds": 2.0, "psnr_db": 39.0}],
        "stages": [
            {"name": "ingest", "seconds": 1.5, "peak_rss_bytes": 10**8, "splats_per_second": 400.0, "tasks": 2},
            {"name": "pack", "seconds": 0.5, "peak_rss_bytes": None},
        ],
        "settings": {"preset": HOSTILE, "seed": 0},
    }


def built(scene, file_bytes, record=None, views=()) -> dict:
    """The report as report.json has it, of a record in JSON."""
    shown = msgspec.convert(strict(list(views)), tuple[ViewMeasured, ...])
    return as_json(build_report(scene, file_bytes, msgspec.convert(strict(record or {}), RunRecord), shown))


def full_views(folder):
    """Rows as make_previews returns them, with pictures on disk."""
    rng, rows = np.random.default_rng(0), []
    for i in range(2):
        pictures = {kind: f"previews/{i}.{kind}.png" for kind in ("packed", "baseline", "photo")}
        for path in pictures.values():
            save_picture(folder / path, rng.integers(0, 255, (30, 40, 3)).astype(np.uint8))
        rows.append(
            {
                "camera": HOSTILE,
                "width_px": 40,
                "height_px": 30,
                "coverage": 0.5,
                "holes": 0.01,
                "psnr_vs_baseline_db": 40.0,
                "ssim_vs_baseline": 0.98,
                "psnr_vs_photo_db": 30.0,
                "ssim_vs_photo": None,
                "baseline_psnr_vs_photo_db": None,
                "seconds": {"cull": 0.001, "attribute": 0.1},
                "baseline_seconds": {"cull": 0.001, "attribute": 0.2},
                "device": "llvmpipe",
                "pictures": pictures,
            }
        )
    return rows


def strictly_parsed(path):
    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


# --- report.json -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_photos", [0, 2])
@pytest.mark.parametrize("n_dictionary", [0, 20])
@pytest.mark.parametrize("record", [None, {}, full_record()])
def test_report__has_all_keys_whatever_was_recorded(n_photos, n_dictionary, record):
    scene = tiny(n_photos, n_dictionary)
    report = built(scene, 1000, record)
    for part, keys in KEYS.items():
        assert keys <= set(report[part] if part else report)
    assert len(report["atoms"]["histogram"]) == scene.header.n_ranks + 1
    for entry in report["learning"]:
        assert {"seconds", "psnr_db"} <= set(entry)
    for stage in report["stages"]:
        assert {"name", "seconds", "peak_rss_bytes"} <= set(stage)


def test_report__counts_every_array_once_and_the_camera_not_at_all():
    scene = tiny()
    sizes = built(scene, 1000)["sizes"]
    on_gpu = sum(array.nbytes for name, array in scene.arrays.items() if name != "camera")
    assert sizes["gpu_bytes"] == on_gpu
    assert sum(sizes[f"{part}_bytes"] for part in ("geometry", "codes", "colors", "dictionary", "maps")) == on_gpu
    assert sizes["colors_bytes"] == 3 * N and sizes["provenance_bytes"] == 2 * N
    assert sizes["geometry_bytes"] == 5 * N + 27 * 4  # 24 + 16 bits a splat, and four boxes
    assert sizes["bytes_per_splat"] == on_gpu / N
    assert sizes["file_bytes"] == 1000


def test_report__counts_boxes_of_colours_as_colours():
    rng = np.random.default_rng(0)
    scene = build_scene(sheet(rng, N), Settings(color_step=112))
    arrays = scene.arrays
    sizes = built(scene, 1000)["sizes"]
    assert sizes["colors_bytes"] == 16 * 4 + arrays["colors"].nbytes and "color" not in arrays
    assert sizes["colors_bytes"] < 3.7 * N  # of random colours; 4 boxes of 128 splats


def test_report__compression_factors_are_those_of_table_1():
    sizes = built(tiny(n_photos=2), 1000)["sizes"]
    source, geometry = 2 * 200 * 100 * 3 * 4 / 3, sizes["geometry_bytes"]
    assert sizes["source_texture_bytes"] == source
    assert sizes["compression_factor_total"] == pytest.approx((geometry + source) / sizes["gpu_bytes"])
    assert sizes["compression_factor_texture"] == pytest.approx(source / (sizes["gpu_bytes"] - geometry))


def test_report__of_a_scan_without_photographs_has_no_compression_factor():
    sizes = built(tiny(n_photos=0, n_dictionary=0), 1000)["sizes"]
    for key in ("source_texture_bytes", "compression_factor_total", "compression_factor_texture"):
        assert sizes[key] is None
    assert sizes["dictionary_bytes"] == 0


def test_report__counts_atoms_as_the_codes_have_them():
    scene = tiny()
    atoms = built(scene, 1000)["atoms"]
    assert atoms["histogram"] == np.bincount(scene.n_atoms, minlength=scene.header.n_ranks + 1).tolist()
    assert atoms["mean"] == pytest.approx(scene.n_atoms.mean())


def test_report__takes_what_was_recorded_over_what_the_file_says():
    scene = tiny()
    scene = replace(scene, header=replace(scene.header, scan={"name": "old", "format": "ply"}, settings={"seed": 1}))
    alone, recorded = built(scene, 1000), built(scene, 1000, full_record())
    assert (alone["scan"]["name"], alone["scan"]["n_cameras"], alone["settings"]) == ("old", 2, {"seed": 1})
    assert alone["quality"]["texture_psnr_db"] is None and alone["learning"] == alone["stages"] == []
    assert recorded["scan"]["name"] == HOSTILE and recorded["settings"]["seed"] == 0
    assert recorded["warnings"] == [HOSTILE]


def test_report__is_strict_json_whatever_numbers_it_is_given(tmp_path):
    record = full_record()
    record["quality"] |= {"texture_psnr_db": float("inf"), "visible_psnr_db": float("nan")}
    record["learning"] = [{"seconds": np.float64(1), "psnr_db": np.float32("nan")}]
    record["settings"] = {"seed": np.int64(3), "names": ("a", "\udcff"), "levels": np.arange(2)}
    made = built(tiny(), np.int64(1000), record)
    json.dumps(made, allow_nan=False)
    report = strictly_parsed(write_report(tmp_path, made))
    assert report["quality"]["texture_psnr_db"] is report["quality"]["visible_psnr_db"] is None
    assert report["learning"][0]["seconds"] == 1.0 and report["learning"][0]["psnr_db"] is None
    assert report["settings"] == {"seed": 3, "names": ["a", "?"], "levels": [0, 1]}


@pytest.mark.parametrize(
    "write",
    [
        lambda folder, report, scene: write_report(folder, report),
        write_page,
        lambda folder, report, scene: save_picture(folder / "a.png", np.zeros((4, 4, 3), np.uint8)),
    ],
)
def test_files__keep_what_was_there_when_writing_fails(tmp_path, monkeypatch, write):
    for name in ("report.json", "report.html", "a.png"):
        (tmp_path / name).write_text("old")

    def fail(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="no space"):
        write(tmp_path, built(tiny(), 1000), tiny())
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == dict.fromkeys(
        ("report.json", "report.html", "a.png"), "old"
    )


# --- report.html -----------------------------------------------------------------------------------------------------


class Elements(HTMLParser):
    """All start tags of a page with their attributes, and its text outside of scripts and styles."""

    def __init__(self, page):
        super().__init__()
        self.tags, self.text, self._inside = [], [], ""
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        self._inside = tag

    def handle_endtag(self, tag):
        self._inside = ""

    def handle_data(self, data):
        if self._inside not in ("script", "style"):
            self.text.append(data)


@pytest.fixture
def full_page(tmp_path):
    return page_of(built(tiny(name=HOSTILE), 1000, full_record(), full_views(tmp_path)), tiny(), tmp_path)


def test_page__loads_nothing_from_anywhere(full_page):
    for tag, attributes in Elements(full_page).tags:
        assert tag not in ("link", "iframe", "object", "embed", "base")
        for key in ("src", "href", "srcset", "data", "action", "poster"):
            assert attributes.get(key, "data:").startswith("data:"), (tag, attributes)
    style = full_page.split("<style>")[1].split("</style>")[0]
    assert "url(" not in style and "@import" not in style


def test_page__shows_every_text_of_the_user_escaped(full_page):
    elements = Elements(full_page)
    shown = "".join(elements.text)
    assert shown.count(HOSTILE) >= 1 + 1 + 1 + 2 * 2  # name, warning, setting, and every view in table and heading
    n_images = sum(tag == "img" for tag, _ in elements.tags)
    assert n_images == 2 * 3 + 1  # the views' and the dictionary: no image of the hostile text's
    assert not any("x.test" in attributes.get("src", "") for _, attributes in elements.tags)


def test_page__gives_no_text_of_the_user_to_the_plots(full_page):
    # Bokeh fetches a typesetter from outside for labels with TeX in them.
    plots = full_page[full_page.rindex("const docs_json") :]
    assert "$$" not in plots and "x.test" not in plots


def test_page__has_a_plot_for_all_that_was_recorded(full_page):
    figures = [a for tag, a in Elements(full_page).tags if tag == "div" and "data-root-id" in a]
    assert len(figures) == 6  # sizes, atoms, learning, seconds, memory, views


@pytest.mark.parametrize("n_photos", [0, 2])
@pytest.mark.parametrize("n_dictionary", [0, 1, 20])
def test_page__is_made_of_a_packed_file_alone(tmp_path, n_photos, n_dictionary):
    scene = tiny(n_photos, n_dictionary)
    path = write_page(tmp_path, built(scene, 1000), scene)
    assert "No pictures were made" in path.read_text(encoding="utf-8")


def test_page__of_stations_tells_where_colours_come_from_and_has_all_parts(tmp_path):
    for scene, said, unsaid in (
        (PackedFile(MAPS).load(), "pictures of what the stations saw", "Every splat has one colour"),
        (tiny(n_photos=0), "are the dictionary of their textures", "Every splat has one colour"),
        (tiny(n_photos=0, n_dictionary=0), "Every splat has one colour", "Texture PSNR"),
    ):
        report = built(scene, 1000, {"quality": {"texture_psnr_db": 36.5}} if "PSNR" not in unsaid else None)
        page = page_of(report, scene, tmp_path)
        assert said in page and unsaid not in page
        shown = parts_of(scene.header.geometry, report["sizes"])
        assert sum(report["sizes"][f"{part}_bytes"] for part in shown) == report["sizes"]["gpu_bytes"]
        assert set(shown) <= set(PART_COLORS)
        assert page.count("36.50 dB") == (2 if "PSNR" not in unsaid else 0)  # the card, and the row of its meaning


def test_geometry_figures__speak_of_the_form_that_the_file_has():
    effects = [{"effect": "ellipsoids", "enabled": True}]
    for report, said in (
        ({"runs": None, "effects": []}, "quantisation moves a splat"),
        ({"runs": None, "effects": effects}, "where it is an ellipsoid by its centre"),
        ({"runs": {"cell": 1.0}, "effects": []}, "centres of their cells"),
    ):
        assert said in geometry_figures(report)[0][3]


def test_page__takes_figures_that_are_missing_one_by_one(tmp_path):
    record, views = full_record(), full_views(tmp_path)
    record["learning"][1]["psnr_db"] = record["stages"][0]["seconds"] = record["quality"]["geometry"] = None
    views[0] |= dict.fromkeys(("psnr_vs_baseline_db", "ssim_vs_baseline", "baseline_seconds"))
    assert page_of(built(tiny(), 1000, record, views), tiny(), tmp_path)


def test_page__embeds_pictures_within_its_budget():
    noise = np.random.default_rng(0).integers(0, 255, (700, 1000, 3)).astype(np.uint8)
    budget = ALL_PICTURES_BYTES // 36
    for rgb in (noise, noise.transpose(1, 0, 2)):
        assert budget / 2 < len(jpeg_within(rgb, budget)) <= budget


def test_pictures__survive_their_file(tmp_path):
    from pipeline.readers.photos import decode_photo

    rgb = np.random.default_rng(0).integers(0, 255, (31, 17, 3)).astype(np.uint8)
    save_picture(tmp_path / "new" / "a.png", rgb[:, ::-1])
    assert (decode_photo(str(tmp_path / "new" / "a.png"), "a.png") == rgb[:, ::-1]).all()


# --- the dictionary --------------------------------------------------------------------------------------------------


def test_atom_uses__count_the_splats_that_name_each_atom():
    scene = tiny()
    atom, _ = scene.codes()
    expected = [sum(k in atom[i, :n] for i, n in enumerate(scene.n_atoms)) for k in range(20)]
    repeats = sum(n - len(set(atom[i, :n])) for i, n in enumerate(scene.n_atoms))
    assert atom_uses(scene).sum() == sum(expected) + repeats == scene.n_atoms.sum()


def test_dictionary_picture__begins_with_the_most_used_atom_around_grey():
    scene = tiny()
    most_used = int(atom_uses(scene).argmax())
    corner = dictionary_picture(scene)[GAP_PX : GAP_PX + PATCH_SIZE, GAP_PX : GAP_PX + PATCH_SIZE]
    assert (corner.astype(int) - 128 == scene.arrays["atoms_32"][most_used]).all()


def test_dictionary_picture__shows_no_more_atoms_than_asked():
    cell = PATCH_SIZE + GAP_PX
    assert dictionary_picture(tiny(n_dictionary=20), max_shown=9).shape == (3 * cell + GAP_PX, 3 * cell + GAP_PX, 3)
    assert dictionary_picture(tiny(n_dictionary=20)).shape == (4 * cell + GAP_PX, 5 * cell + GAP_PX, 3)
    assert dictionary_picture(tiny(n_dictionary=0)) is None
