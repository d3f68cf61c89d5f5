"""Laser scans with textures: a tenth of the points show what all of them show."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import to_builtins
from PIL import Image

from pipeline.execution.executors import DaskExecutor, SerialExecutor
from pipeline.execution.stage import Stage, StageRecord
from pipeline.maps.light import levels_with
from pipeline.maps.station_map import NOTHING
from pipeline.planning.knobs import KNOBS
from pipeline.planning.settings import settings_for
from pipeline.readers.attributes.options import ReadOptions
from pipeline.stages.maps.panoramas import Panoramas, read_map
from pipeline.stages.maps.resample_maps import ResampleMaps
from pipeline.stages.maps.station_light import StationGains
from pipeline.stages.pages.codecs import decoded
from pipeline.summaries import Points
from renderer.evaluate.compare import psnr_of_error
from renderer.splats.renderer import Renderer
from renderer.splats.scene import GpuScene
from services.cli.arguments import add_knobs, add_preset
from services.cli.commands.looks import add_edited_maps, settings_with_maps
from services.cli.parser import WrongArgument
from services.flow.asked import prepare_asked
from services.flow.beside import make_beside
from services.flow.code import texture
from services.flow.map_pictures import map_scan
from services.flow.run import Run
from services.processes import estimate as pilot
from services.processes.compress import compress, make
from storage.errors import InvalidScan
from storage.maps import IN_PART, NO_MAP
from storage.packed.packed import PackedFile
from storage.packed.schema import Camera
from storage.pages.file import PageFile
from storage.work import arrays, work
from tests.pipeline.execution.test_stage import Heard
from tests.services.processes.dying import DyingPanoramas, DyingResampleMaps
from tests.services.scans import point_scan
from tests.stations import HALF, PILLAR, cast, room_color, scanned, write_e57

SETTINGS = settings_for(
    "draft", density=0.1, radius=0.25, training_splats=4000, iterations=2, effects="pages=on", page_codec="png"
)
THINNER = replace(SETTINGS, texture="map", density=0.03, radius=0.5)
STATIONS = [[-1.0, -0.8, 0.2], [0.4, 1.3, -0.1]]
MAP_STAGES = {"panoramas", "station-light", "resample-maps"}
OF_MAPS = MAP_STAGES | {"map-pictures", "mapped-splats", "map-pages"}
DYING = {Panoramas: DyingPanoramas, ResampleMaps: DyingResampleMaps}
VIEW = Camera(
    "near", 320, 240, 200.0, 200.0, 160.0, 120.0, ((0.0, -1, 0), (0, 0, -1), (1, 0, 0)), (-0.8, -0.9, 0.1)
)  # along +x


@pytest.fixture(scope="module")
def scan(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("stations") / "room.e57"
    return write_e57(path, scanned(STATIONS[0], 1.2), scanned(STATIONS[1], 1.2, gain=0.8))


@pytest.fixture(scope="module")
def made(scan, tmp_path_factory):
    """A function from settings to the report, the packed file and the work folder."""
    folder = tmp_path_factory.mktemp("made")
    known: dict = {}

    def make(settings, executor=None, name=""):
        key = (settings, name)
        if key not in known:
            out, kept = folder / f"out-{len(known)}", folder / (f"work-{name}" if name else "work")
            report = compress(scan, out, settings, executor or SerialExecutor(), Heard(), render=False, work=kept)
            known[key] = report, out / "room.splatpress", kept
        return known[key]

    return make


def stages_of(report: dict) -> set[str]:
    return {stage["name"] for stage in report["stages"]}


def picture_psnr_db(path: Path, renderer: Renderer) -> float:
    """Of the picture from VIEW against rays cast at the room itself, where splats cover it."""
    with PackedFile(path) as packed:
        gpu_scene = GpuScene(packed.load(), renderer.context)
    picture = renderer.render(gpu_scene, VIEW)
    gpu_scene.release()
    column, row = np.meshgrid(np.arange(VIEW.width_px) + 0.5, np.arange(VIEW.height_px) + 0.5)
    local = np.stack([(column - VIEW.cx_px) / VIEW.fx_px, (row - VIEW.cy_px) / VIEW.fy_px, np.ones_like(row)], axis=-1)
    point, _ = cast(np.array(VIEW.centre), local.reshape(-1, 3) @ np.array(VIEW.rotation))
    truth = room_color(point).reshape(*row.shape, 3)
    assert picture.coverage.mean() > 0.85
    error = (picture.rgb.astype(float) - truth)[picture.coverage]
    return psnr_of_error(float((error**2).mean()))


def test_maps__a_tenth_of_the_points_with_texture_is_4_db_above_one_colour_a_splat(made, renderer):
    with_maps, flat = made(SETTINGS), made(replace(SETTINGS, texture="color"))
    assert stages_of(with_maps[0]) >= MAP_STAGES and not stages_of(flat[0]) & MAP_STAGES
    assert with_maps[0]["quality"]["texture_psnr_db"] > 28 and flat[0]["quality"]["texture_psnr_db"] is None
    textured_db, flat_db = (picture_psnr_db(path, renderer) for path in (with_maps[1], flat[1]))
    assert textured_db > flat_db + 4


def test_maps__themselves_in_the_file_are_4_db_above_one_colour_where_splats_are_large(made, renderer):
    """The map of each splat is looked up by its fragments; so points may go, and pictures stay."""
    itself = made(THINNER, name="thinner")
    assert stages_of(itself[0]) >= {"map-pictures", "mapped-splats"} and "resample-maps" not in stages_of(itself[0])
    assert itself[0]["quality"]["texture_psnr_db"] >= 36 and itself[0]["sizes"]["maps_bytes"] > 0
    with PackedFile(itself[1]) as packed:
        header, station = packed.header, packed.read("station")
    assert (
        len(header.maps) == 2
        and set(np.unique(station % IN_PART)) <= {0, 1, NO_MAP % IN_PART}
        and (station == 255).mean() < 0.02
    )
    assert header.maps[0].centre == pytest.approx(STATIONS[0])
    flat = made(replace(THINNER, texture="color"), name="thinner")
    assert picture_psnr_db(itself[1], renderer) > picture_psnr_db(flat[1], renderer) + 4


def test_maps__stand_in_the_report_beside_what_textures_gain(scan, made, tmp_path):
    """Near a station and away of it."""
    _, _, folder = made(THINNER, name="thinner")
    run = Run(folder, SerialExecutor(), Heard(), draw=lambda *_: [])
    report = make(run, scan, THINNER, tmp_path)
    assert json.loads((tmp_path / "report.json").read_text())["stations"] == report["stations"]
    assert [row["centre"] for row in report["stations"]] == [pytest.approx(centre) for centre in STATIONS]
    for row in report["stations"]:
        with Image.open(tmp_path / row["pictures"]["map"]) as picture:
            assert picture.width == 6 * picture.height and 0.9 < row["covered"] <= 1
        near, *away = row["views"]
        assert near["textured_db"] > near["flat_db"] + 4 and near["points"] > 5_000
        assert len(away) == 2 and all(view["textured_db"] > view["flat_db"] for view in away)
        assert all((tmp_path / path).is_file() for view in row["views"] for path in view["pictures"].values())
    page = (tmp_path / "report.html").read_text()
    assert page.count('alt="Map of station') == 2 and page.count('alt="Textured, ') == 6


def test_maps__auto_takes_the_fewer_bytes_and_says_why(made):
    def choice(settings, name=""):
        report = made(settings, name=name)[0]
        row = next(row for row in report["effects"] if row["effect"] == "station_maps")
        return row["choice"], report["sizes"]["maps_bytes"]

    words, n_bytes = choice(SETTINGS)  # 8,000 splats of maps of 2 x 46,000 texels
    assert words.startswith("atoms: maps take about") and n_bytes == 0
    words, n_bytes = choice(THINNER, "thinner")
    assert words.startswith("map: maps take about") and words.endswith("asked for") and n_bytes > 0


def test_maps__the_plan_says_whether_and_why(made):
    def row_of(report: dict) -> dict:
        return next(row for row in report["effects"] if row["effect"] == "station_maps")

    asked = row_of(made(SETTINGS)[0])
    assert asked["enabled"] and asked["request"] == "auto" and asked["measure"] == pytest.approx(10, rel=0.05)
    whole = made(replace(SETTINGS, density=1.0))[0]
    assert not row_of(whole)["enabled"] and row_of(whole)["measure"] == 1 and not stages_of(whole) & MAP_STAGES
    assert row_of(made(replace(SETTINGS, texture="color"))[0])["request"] == "off"


def test_maps__stations_are_brought_to_one_light(made):
    _, _, folder = made(SETTINGS)
    (light,) = folder.glob("station-light-*")
    found = work.summary(light, StationGains)
    assert found.spread_after < found.spread_before / 2
    gain = np.array(found.log_gain)
    # 0.8 of a level is about 0.8^2.2 of linear light
    np.testing.assert_allclose(gain[1] - gain[0], np.log(0.8**-2.2), atol=0.12)


def test_maps__bytes_depend_neither_on_the_executor_nor_on_workers_that_are_killed(scan, made, tmp_path):
    """While maps are drawn and while they are looked up: all stages of maps once more, by two workers of which one dies
    in each of these two."""
    of_maps: dict[Path, Stage] = {}

    def noted(stage: Stage, do) -> StageRecord:
        record = do()
        if stage.name in OF_MAPS:
            of_maps[record.folder] = stage
        return record

    _, _, folder = made(THINNER, name="thinner")
    run = Run(folder, SerialExecutor(), Heard(), noted)
    prepared = prepare_asked(run, scan, THINNER)
    texture(run, prepared, THINNER)
    run.do(ResampleMaps(prepared.on_maps(prepared.maps.folder), prepared.maps.log_gain))
    make_beside(run, prepared, THINNER, tmp_path / "room.pages")
    assert {stage.name for stage in of_maps.values()} == OF_MAPS
    with DaskExecutor(2) as executor:
        run = Run(tmp_path / "work", executor, Heard())
        for folder, stage in of_maps.items():
            dying = DYING.get(type(stage))
            found = run.do(dying(**vars(stage)) if dying else stage)
            assert contents(found.folder) == contents(folder)
            assert found.summary == work.summary(folder, type(found.summary))
    assert {p.name.rsplit("-", 1)[0] for p in (tmp_path / "work").glob("*.died")} == {"panoramas", "resample-maps"}


def contents(folder: Path) -> dict[str, bytes]:
    """All arrays of a stage, byte for byte."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.glob("*.zarr/*")}


def test_maps__their_pages_are_those_of_the_maps_in_one_light(made):
    report, packed, folder = made(SETTINGS)
    path = packed.with_suffix(".pages")
    assert report["pages"]["bytes"] == path.stat().st_size and report["pages"]["psnr_db"] == 100.0
    (maps,) = folder.glob("panoramas-*")
    with PageFile(path) as file:
        assert file.header.names == ("station 0", "station 1") and file.header.one_light
        seen = read_map(maps, 0)
        assert file.layout.sizes_px[0] == (6 * seen.frame.height_px, seen.frame.height_px)
        page = decoded("png", file.read(0), file.header.side_px, "a page")[4:-4, 4:-4]
    (light,) = folder.glob("station-light-*")
    levels = np.rint(levels_with(work.summary(light, StationGains).log_gain[0]))
    known = seen.depth[:128, :128] != NOTHING
    wanted = np.stack([levels[:, k][seen.color[:128, :128, k]] for k in range(3)], axis=-1)
    assert known.any() and np.array_equal(page[: known.shape[0]][known], wanted[known])


def test_maps__an_estimate_tells_what_the_file_with_maps_has(scan, made, monkeypatch):
    """Pictures are as large whatever the sample; atoms would be told as a hundredth of these bytes."""
    report, _, folder = made(THINNER, name="thinner")
    monkeypatch.setattr(pilot, "SAMPLE", 500)
    found = to_builtins(pilot.estimate(scan, THINNER, SerialExecutor(), Heard(), folder))
    assert found["sample"]["n_splats"] < found["splats"] / 2
    assert found["gpu_bytes"]["value"] == pytest.approx(report["sizes"]["gpu_bytes"], rel=0.01)
    assert found["sizes"]["maps_bytes"] == report["sizes"]["maps_bytes"]
    assert found["texture_psnr_db"]["value"] == pytest.approx(report["quality"]["texture_psnr_db"], abs=1e-9)
    assert {"map-pictures", "mapped-splats"} <= {row["name"] for row in found["stages"]}


def test_maps__atoms_of_a_scan_without_stations_are_an_error_that_says_what_to_do(tmp_path):
    scan = point_scan(tmp_path / "points.ply")
    with pytest.raises(InvalidScan, match=r"texture.*neither photographs.*--station") as caught:
        compress(scan, tmp_path / "out", replace(SETTINGS, density=1.0, texture="atoms"), SerialExecutor(), Heard())
    assert caught.value.kind == "data" and not (tmp_path / "out").exists()
    with pytest.raises(InvalidScan, match=r"texture.*without stations.*--station"):
        compress(scan, tmp_path / "out", replace(SETTINGS, density=1.0, texture="map"), SerialExecutor(), Heard())


# --- maps as pictures ------------------------------------------------------------------------------------------------


def test_map__writes_a_picture_a_station_and_takes_it_back_edited(scan, made, tmp_path, renderer):
    """What is painted on the maps is what the packed file shows there: all of the wall that VIEW looks at, in green."""
    rows = map_scan(scan, tmp_path / "maps", SerialExecutor(), Heard(), work=tmp_path / "work")
    assert [row["station"] for row in rows] == [0, 1] and all(0.9 < row["covered"] <= 1 for row in rows)
    assert sorted(p.name for p in (tmp_path / "maps").iterdir()) == sorted(sum((row["files"] for row in rows), []))
    for i in range(2):
        paint(tmp_path / "maps" / f"station_{i:03d}.color.png")
    out = tmp_path / "out"
    settings = replace(SETTINGS, texture="atoms")
    compress(
        scan,
        out,
        settings,
        SerialExecutor(),
        Heard(),
        render=False,
        work=tmp_path / "work",
        edited_maps=tmp_path / "maps",
    )
    with PackedFile(out / "room.splatpress") as packed:
        gpu_scene = GpuScene(packed.load(), renderer.context)
    rgb, coverage = (picture := renderer.render(gpu_scene, VIEW)).rgb, picture.coverage
    gpu_scene.release()
    is_green = np.abs(rgb[coverage].astype(int) - [0, 200, 60]).max(axis=1) < 30
    assert is_green.mean() > 0.95


def settings_asked(*words: str):
    parser = argparse.ArgumentParser()
    add_knobs(parser, [knob.name for knob in KNOBS])
    add_preset(parser)
    add_edited_maps(parser)
    return settings_with_maps(parser.parse_args([*words]))


def test_compress__edited_maps_ask_for_a_texture_and_keep_the_one_asked_for():
    assert settings_asked("--maps", "dir").texture == "atoms"
    assert settings_asked("--maps", "dir", "--texture", "map").texture == "map"
    assert settings_asked("--texture", "color").texture == "color"
    with pytest.raises(WrongArgument, match="allowed: --texture auto, atoms, map"):
        settings_asked("--maps", "dir", "--texture", "color")


def paint(path: Path) -> None:
    """All that was seen becomes green."""
    with Image.open(path) as picture:
        pixels = np.array(picture)
    pixels[..., :3] = [0, 200, 60]
    Image.fromarray(pixels).save(path)


def test_map__of_a_scan_without_stations_is_an_error_and_leaves_nothing(tmp_path):
    scan = point_scan(tmp_path / "points.ply")
    with pytest.raises(InvalidScan, match=r"no station.*--station"):
        map_scan(scan, tmp_path / "maps", SerialExecutor(), Heard())
    assert not (tmp_path / "maps").exists()


def test_map__with_the_scanner_s_place_a_merged_scan_has_one(tmp_path):
    scan = point_scan(tmp_path / "points.ply")  # a ball of radius 2
    rows = map_scan(scan, tmp_path / "maps", SerialExecutor(), Heard(), reading=ReadOptions(station="0,0,0"))
    assert len(rows) == 1 and rows[0]["covered"] > 0.95 and rows[0]["centre"] == [0, 0, 0]


def test_compress__an_empty_folder_of_maps_is_an_error_that_names_what_it_should_hold(scan, made, tmp_path):
    (tmp_path / "maps").mkdir()
    _, _, work_folder = made(SETTINGS)
    run = {"render": False, "work": work_folder, "edited_maps": tmp_path / "maps"}
    with pytest.raises(InvalidScan, match=r"no map.*station_000.color.png to station_001.color.png"):
        compress(scan, tmp_path / "out", replace(SETTINGS, texture="atoms"), SerialExecutor(), Heard(), **run)
    with pytest.raises(InvalidScan, match="none texture"):
        settings = replace(SETTINGS, texture="color")
        compress(scan, tmp_path / "out", settings, SerialExecutor(), Heard(), **run)


def test_maps__cliplines_come_from_their_silhouettes(made):
    """The pillar's edges are some: splats on the pillar that reach over them are clipped, those amid walls are not."""
    report, path, folder = made(replace(SETTINGS, effects="cliplines=on,ellipsoids=off"))
    assert "map-cliplines" in stages_of(report)
    lines = max(folder.glob("map-cliplines-*"), key=lambda p: p.stat().st_mtime_ns)
    (partition,) = (p for p in folder.glob("partition-*") if is_thinned(p))
    has = arrays.read(lines, "has_clipline")
    position = arrays.read(partition, "position") + np.array(work.summary(partition, Points).origin)
    with PackedFile(path) as packed:
        scene = packed.load()
    assert sum(batch.clipline for batch in scene.header.batches) and 0 < has.mean() < 0.5
    off_pillar = np.abs(position[:, :2] - PILLAR[:2]).max(axis=1)
    of_pillar = np.abs(off_pillar - PILLAR[2]) < 1e-3
    amid_walls = (off_pillar > 1.0) & ((HALF - np.abs(position) > 0.6).sum(axis=1) == 2)
    assert has[of_pillar].mean() > 0.1 and has[amid_walls].mean() < 0.05


def is_thinned(partition: Path) -> bool:
    return work.summary(partition, Points).n_splats < 20_000
