"""From a scan to a packed file over quadrics: each splat in its own place with its own colour, and what the plan
says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.geometry.normals import decode_normals
from pipeline.splats.decoded import scene_normal_codes, scene_positions, scene_radii
from services.cli.main import main
from storage.packed.schema import QUADRICS
from tests.hard_cases.scans import write_points
from tests.pipeline.geometry.runs.test_cells import sphere
from tests.services.processes.test_runs import Backwards, compressed

CENTRE = np.array([1000.0, -50.0, 3.0])


@pytest.fixture(scope="module")
def ball(tmp_path_factory) -> Path:
    unit = sphere(5_000)
    color = np.round(127.5 + 127 * unit).astype(np.uint8)  # that say where a splat is
    path = tmp_path_factory.mktemp("scan") / "ball.ply"
    write_points(path, 2 * unit + CENTRE, unit.astype(np.float32), color)
    return path


@pytest.fixture(scope="module")
def made(ball, tmp_path_factory):
    out = tmp_path_factory.mktemp("quadrics") / "out"
    return *compressed(ball, out, geometry="quadrics"), (out / "ball.splatpress").read_bytes()


def test_quadrics__keep_places_normals_and_colours_together(made):
    told, scene, _ = made
    assert scene.header.geometry == QUADRICS
    outwards = (scene_positions(scene) + scene.header.origin - CENTRE) / 2
    off = np.abs(np.linalg.norm(outwards, axis=1) - 1) * 2
    assert off.mean() < scene_radii(scene).mean() / 30
    cosine = (decode_normals(scene_normal_codes(scene)) * outwards).sum(axis=1) / np.linalg.norm(outwards, axis=1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 2
    assert np.abs(scene.arrays["color"] - (127.5 + 127 * outwards)).mean() < 3
    assert told["quality"]["geometry"]["mean_position_error_in_radii"] == pytest.approx(1 / 30, rel=0.1)


def test_quadrics__take_fewer_bits_and_the_plan_says_so(made):
    told, scene, _ = made
    row = told["effects"][0]
    assert row["effect"] == "geometry_quadrics" and row["enabled"] and row["measure"] < 1
    sizes = sum(scene.arrays[name].nbytes for name in ("size_scale", "sizes") if name in scene.arrays)
    assert 8 * (told["sizes"]["geometry_bytes"] - sizes) / told["splats"] < 33


def test_quadrics__are_the_same_bytes_for_any_order_of_tasks(ball, made, tmp_path):
    compressed(ball, tmp_path / "out", Backwards(), geometry="quadrics")
    assert (tmp_path / "out" / "ball.splatpress").read_bytes() == made[2]


def test_quadrics__auto_takes_what_is_smaller_at_the_asked_error(ball, tmp_path):
    told, scene = compressed(ball, tmp_path / "coarse", geometry_error=0.1)
    assert scene.header.geometry == QUADRICS and told["effects"][0]["measure"] < 1
    rng = np.random.default_rng(0)
    cloud = write_points(
        tmp_path / "cloud.ply", rng.uniform(0, 1, (2_000, 3)), rng.permutation(sphere(2_000)).astype(np.float32)
    )
    told, scene = compressed(cloud, tmp_path / "fine", geometry_error=0.001)
    row = told["effects"][0]
    assert scene.header.geometry == "boxes" and not row["enabled"] and row["measure"] >= 1
    told, scene = compressed(
        ball, tmp_path / "boxes", geometry="boxes", geometry_error=0.1, levels=2, dictionary="shipped"
    )
    assert scene.header.geometry == "boxes" and told["effects"][0]["effect"] != "geometry_quadrics"
    assert "geometry_error 0.1 is not used: it is of quadrics" in told["warnings"]
    assert "dictionary shipped is not used: nothing in the scan is coded by atoms" in told["warnings"]
    assert any(
        w.startswith("levels 2 is more than there are") and w.endswith(" 0, each of 32,768 or more of the next")
        for w in told["warnings"]
    )


def test_quadrics__with_levels_are_drawn_through_a_pool_as_from_memory(tmp_path):
    unit = sphere(33_000)
    scan = write_points(tmp_path / "ball.ply", 2 * unit + CENTRE, unit.astype(np.float32))
    compressed(scan, tmp_path / "out", geometry="quadrics", levels=1, effects="all=off")
    pictures = []
    for more in ([], ["--pool-mib", "64"]):
        out = tmp_path / f"pictures{len(more)}"
        packed = str(tmp_path / "out" / "ball.splatpress")
        assert main(["render", packed, "--orbit", "1", "--size", "96x80", "--out", str(out), *more]) == 0
        pictures.append(np.asarray(Image.open(next(out.glob("*.png"))).convert("RGB")))
    off = np.square(pictures[0].astype(float) - pictures[1]).mean()
    assert off < 255**2 / 1e5 and pictures[0].std() > 10  # 50 dB
