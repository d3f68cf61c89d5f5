"""From a volume to a packed file: the surfaces asked for, in the file's own frame, lit; and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from pipeline.execution.executors import DaskExecutor, SerialExecutor
from pipeline.geometry.normals import decode_normals
from pipeline.geometry.positions import Boxes, decode_positions
from pipeline.geometry.runs.gaps import ENOUGH
from pipeline.planning.settings import settings_for
from pipeline.splats.decoded import scene_normal_codes, scene_positions
from renderer.evaluate.compare import psnr_db
from renderer.splats.scene import GpuScene
from renderer.splats.views import hides_backs, orbit_views
from services.cli.main import main
from services.processes.compress import compress
from services.processes.inspect import check, inspect
from services.processes.report import report
from storage.errors import InvalidScan, UnsupportedScan
from storage.packed.packed import PackedFile
from tests.hard_cases.scans import write_points
from tests.pipeline.execution.test_stage import Heard
from tests.pipeline.readers.shared_data import shared_scan
from tests.pipeline.volumes.made import ball, middle_of, write_nrrd
from tests.services.processes.published_schemas import misfits

SHAPE, SPACING = (30, 28, 40), (0.5, 0.5, 0.4)
LPS = "space: left-posterior-superior\nspace directions: (-0.5,0,0) (0,0.5,0) (0,0,0.4)\nspace origin: (100,-20,7)\n"


@pytest.fixture(scope="module")
def volume(tmp_path_factory) -> Path:
    voxels = ball(SHAPE, SPACING, radius=5.0).astype(np.float32)
    return write_nrrd(tmp_path_factory.mktemp("volume") / "ball.nrrd", voxels, "gzip", LPS)


def packed_of(out: Path) -> tuple[np.ndarray, np.ndarray, object]:
    """Positions in the scan's frame, colours, and the scene."""
    with PackedFile(next(out.glob("*.splatpress"))) as packed:
        scene = packed.load()
    a = scene.arrays
    code = a["position"].astype(np.uint32) @ np.array([1, 1 << 8, 1 << 16], np.uint32)
    position = decode_positions(code, Boxes(a["box_low"], a["box_size"], a["box_bits"])) + scene.header.origin
    return position, a["color"], scene


def made(volume: Path, out: Path, executor=None, **settings) -> dict:
    return compress(volume, out, settings_for("draft", **settings), executor or SerialExecutor(), Heard(), render=False)


def test_compress__a_volume_becomes_the_surfaces_asked_for_in_the_frame_of_the_file(volume, tmp_path):
    told = made(volume, tmp_path / "out", iso="20=#ff0000,50")
    assert not misfits(tmp_path / "out" / "report.json")
    position, color, scene = packed_of(tmp_path / "out")
    middle = np.array([100, -20, 7]) + middle_of(SHAPE, SPACING) * [-1, 1, 1]
    radius = np.linalg.norm(position - middle, axis=1)
    outer = (color == (255, 0, 0)).all(axis=1)
    assert 0 < outer.sum() < len(outer)
    assert np.abs(radius[outer] - 8).max() < 0.1 or np.abs(radius[~outer] - 5).max() < 0.1
    assert np.abs(radius[~outer] - 5).max() < 0.1
    surfaces = told["scan"]["volume"]["surfaces"]
    assert [s["n_points"] for s in surfaces] == [outer.sum(), (~outer).sum()]
    assert told["scan"]["volume"]["frame"] == "left-posterior-superior" and scene.header.unit == "millimetre"
    assert scene.header.effects["relighting"] == {"lamp": True}
    row = next(row for row in told["effects"] if row["effect"] == "relighting")
    assert row["enabled"] and row["request"] == "auto" and "no light in them" in row["reason"]
    assert 0.8 < scene.header.radius / told["scan"]["volume"]["cell"] < 1.3


def test_compress__of_a_volume_makes_the_same_bytes_on_dask(tmp_path):
    """As runs, which splats in boxes are made for first; of a torn surface too no cell is filled that it does not pass."""
    voxels = ball((16, 14, 18), SPACING, radius=2.5).astype(np.float32)
    voxels += 40 * np.random.default_rng(0).normal(size=voxels.shape).astype(np.float32)
    volume = write_nrrd(tmp_path / "ball.nrrd", voxels, "gzip", LPS)
    told = made(volume, tmp_path / "serial", iso="50", geometry="runs")
    assert told["runs"]["added"] == 0 and told["runs"]["efficiency"] < ENOUGH
    with DaskExecutor(2) as executor:
        made(volume, tmp_path / "dask", executor, iso="50", geometry="runs")
    serial, dask = (tmp_path / name / "ball.splatpress" for name in ("serial", "dask"))
    assert serial.read_bytes() == dask.read_bytes()


def test_compress__takes_the_value_that_the_volume_proposes_and_says_so(tmp_path):
    voxels = (ball(SHAPE, SPACING, radius=5.0) > 50) * np.uint16(1000)
    voxels += np.random.default_rng(0).integers(0, 30, voxels.shape).astype(np.uint16)
    told = made(write_nrrd(tmp_path / "a.nrrd", voxels, extra=LPS), tmp_path / "out")
    assert 100 < told["scan"]["volume"]["surfaces"][0]["iso"] < 1000
    assert any("no iso value was given" in text for text in told["warnings"])
    assert not any("names of regions" in text for text in told["warnings"])
    regions = 3 * (ball(SHAPE, SPACING, radius=5.0) > 50).astype(np.uint8)
    told = made(write_nrrd(tmp_path / "b.nrrd", regions, extra=LPS), tmp_path / "labels")
    assert any("values look like names of regions" in text for text in told["warnings"])


def test_compress__a_border_is_open_or_closed_as_asked(tmp_path):
    voxels = np.full((12, 12, 12), 100, np.uint8)
    voxels[:, :, 6:] = 0
    volume = write_nrrd(tmp_path / "half.nrrd", voxels, extra="spacings: 1 1 1\n")
    made(volume, tmp_path / "open", iso="50")
    made(volume, tmp_path / "closed", iso="50", border="closed")
    assert np.allclose(packed_of(tmp_path / "open")[0][:, 0], 5.5, atol=0.01)
    low, high = (f(packed_of(tmp_path / "closed")[0], axis=0) for f in (np.min, np.max))
    assert np.allclose(low, -0.5, atol=0.02) and np.allclose(high, [5.5, 11.5, 11.5], atol=0.02)


def test_compress__a_spacing_that_is_asked_for_counts(volume, tmp_path):
    made(volume, tmp_path / "out", iso="50", spacing="0.5,0.5,0.8")
    extent = np.ptp(packed_of(tmp_path / "out")[0], axis=0)
    assert np.allclose(extent, [10, 10, 20], atol=0.5)


def test_compress__errors_say_what_a_volume_lacks(volume, tmp_path):
    with pytest.raises(InvalidScan, match="values pass from 0 to 95.9"):
        made(volume, tmp_path / "a", iso="500")
    flat = write_nrrd(tmp_path / "flat.nrrd", np.full((4, 4, 4), 7, np.uint8))
    with pytest.raises(InvalidScan, match="all voxels are 7"):
        made(flat, tmp_path / "b")
    nothing = write_nrrd(tmp_path / "nan.nrrd", np.full((4, 4, 4), np.nan, np.float32))
    with pytest.raises(InvalidScan, match="none of its 64 voxels is finite"):
        made(nothing, tmp_path / "c", iso="1")
    points = write_points(tmp_path / "points.ply", np.random.default_rng(0).uniform(size=(500, 3)))
    with pytest.raises(UnsupportedScan, match="volumes only"):
        made(points, tmp_path / "d", iso="1")
    with pytest.raises(ValueError, match="VALUE or VALUE=#RRGGBB"):
        settings_for("draft", iso="forty")


def test_report__of_a_packed_volume_has_its_surfaces(volume, tmp_path):
    first = made(volume, tmp_path / "out", iso="20=#ff0000,50", border="closed")
    again = report(
        tmp_path / "out" / "ball.splatpress", volume, tmp_path / "again", SerialExecutor(), Heard(), render=False
    )
    assert again["scan"]["volume"] == first["scan"]["volume"] and again["warnings"] == first["warnings"]
    assert "Surfaces" in (tmp_path / "again" / "report.html").read_text()


def test_inspect_and_check__of_a_volume(volume, tmp_path, capsys):
    found = inspect(volume)
    assert found["shape"] == list(SHAPE) and found["unit"] == "millimetre" and "spacing differs" in found["warnings"][0]
    assert check(volume)["ok"]
    (tmp_path / "cut.nrrd").write_bytes(volume.read_bytes()[:-500])
    assert not check(tmp_path / "cut.nrrd")["ok"]
    assert main(["inspect", str(volume), "--json"]) == 0
    json.loads(capsys.readouterr().out)


def test_a_volume_of_several_times__is_looked_at_and_compressed_at_the_one_asked_for(volume, tmp_path, capsys):
    voxels = ball(SHAPE, SPACING, radius=5.0).clip(0, 255).astype(np.uint8)
    times = np.stack([np.zeros_like(voxels), voxels])
    path = tmp_path / "times.nii"
    nib.save(nib.Nifti1Image(times.transpose(1, 2, 3, 0), np.diag([*SPACING, 1.0])), path)
    assert main(["inspect", str(path)]) == 5 and "--time 0..1" in capsys.readouterr().err
    assert main(["inspect", str(path), "--time", "1"]) == 0 and main(["check", str(path), "--time", "1"]) == 0
    command = ["compress", str(path), "--iso", "50", "--executor", "serial", "--no-render", "--out"]
    assert main([*command, str(tmp_path / "out"), "--time", "1"]) == 0
    assert (tmp_path / "out" / "times.splatpress").is_file()


def test_iso__prints_a_histogram_and_proposals(volume, tmp_path, capsys):
    assert main(["iso", str(volume), "--executor", "serial", "--json"]) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert sum(found["voxels"]) == np.prod(SHAPE) and 5 < found["proposals"][0]["iso"] < 95
    assert main(["iso", str(volume), "--executor", "serial"]) == 0
    assert "--iso" in capsys.readouterr().out
    assert main(["iso", str(tmp_path)]) == 5


def test_render__surfaces_are_lit_by_a_lamp_unless_that_is_off(volume, tmp_path, renderer):
    def picture(effects: str):
        out = tmp_path / (effects or "usual")
        made(volume, out, iso="50=#808080", effects=effects)
        scene = packed_of(out)[2]
        gpu_scene = GpuScene(scene, renderer.context)
        drawn = renderer.render(gpu_scene, orbit_views(scene, 1, (160, 120))[0])
        gpu_scene.release()
        return drawn.rgb[drawn.coverage].astype(int)

    lit, flat = picture(""), picture("relighting=off")
    assert np.abs(flat - 128).max() <= 1
    assert lit.max() - lit.min() > 40 and lit.max() <= 128


def test_render__backs_of_closed_surfaces_are_left_out_from_outside_and_nothing_else(tmp_path, renderer):
    shape, spacing = (26, 26, 26), (1.0, 1.0, 1.0)
    made(
        write_nrrd(tmp_path / "whole.nrrd", ball(shape, spacing, radius=8.0).astype(np.float32)),
        tmp_path / "whole",
        iso="50",
        geometry="runs",
    )
    made(
        write_nrrd(tmp_path / "cut.nrrd", ball(shape, spacing, radius=8.0)[:14].astype(np.float32)),
        tmp_path / "cut",
        iso="50",
    )
    with PackedFile(tmp_path / "whole" / "whole.splatpress") as packed:
        scene = packed.load()
    views = orbit_views(scene, 3, (200, 150))
    inside = replace(views[0], centre=tuple(scene_positions(scene).mean(axis=0) + scene.header.origin))
    assert hides_backs(scene, views) and not hides_backs(scene, [*views, inside])
    assert not hides_backs(packed_of(tmp_path / "cut")[2], views)
    both, front = (GpuScene(scene, renderer.context, front_only=on) for on in (False, True))
    position, normal = scene_positions(scene) + scene.header.origin, decode_normals(scene_normal_codes(scene))
    for view in views:
        turned = ((position - view.centre) * normal).sum(axis=1) > 0
        a, b = (renderer.render(gpu_scene, view) for gpu_scene in (both, front))
        assert turned.mean() > 0.3
        rim = a.coverage & ~binary_erosion(a.coverage)
        assert (a.coverage != b.coverage).sum() < 0.7 * rim.sum()  # less than a pixel about the outline
        assert (
            psnr_db(a.rgb, b.rgb, binary_erosion(a.coverage & b.coverage, iterations=8)) > 50
        )  # further in than a disc reaches
    both.release()
    front.release()


def test_compress__a_real_volume_lies_on_the_trilinear_surface(tmp_path):
    """Distances in voxels to the triangles' corners and middles of marching cubes, which lie .2 apart."""
    from scipy.spatial import cKDTree
    from skimage.measure import marching_cubes

    from pipeline.volumes.open import open_volume
    from tests.pipeline.volumes.made import read

    volume = open_volume(shared_scan("volume_iguana_ct/iguana.nrrd"))
    made(Path(volume.path), tmp_path / "out", iso="60")
    voxels = read(volume)[0].transpose(2, 1, 0).astype(np.float32)
    corners, triangles, _, _ = marching_cubes(voxels, 60, spacing=volume.spacing)
    position = packed_of(tmp_path / "out")[0]
    far = cKDTree(np.concatenate([corners, corners[triangles].mean(axis=1)])).query(position)[0] / volume.spacing[0]
    assert far.mean() < 0.35 and np.quantile(far, 0.99) < 0.8


def test_cli__compress_takes_a_volume_by_its_relative_name(volume, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(volume.parent)
    arguments = ["compress", volume.name, "--iso", "20", "--out", str(tmp_path / "aus gabe"), "--executor", "serial"]
    assert main([*arguments, "--preset", "draft", "--no-render"]) == 0, capsys.readouterr().err
    assert (tmp_path / "aus gabe" / "ball.splatpress").is_file()
