"""3D Tiles of a file with levels: the tileset by the rules of the specification, contents by Khronos' validator."""

from __future__ import annotations

import json
import struct
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from pipeline.exports.cloud import cloud_of
from services.processes.export import export
from storage.packed.schema import GROUP
from tests.packed_files import write_arrays
from tests.programs_of_others import complaints_of_gltf_validator, upgraded_by_tiles_tools
from tests.scenes import Settings, build_scene, sheet

UTM = (450000.25, 5400000.5, 100.0)
N = GROUP + 4 * GROUP + 300  # a coarser group above five


@pytest.fixture(scope="module")
def tiled(tmp_path_factory):
    """The scene, and the zip that it becomes."""
    folder, rng = tmp_path_factory.mktemp("tiles"), np.random.default_rng(4)
    splats = sheet(rng, N, size=np.where(np.arange(N) < GROUP, 0.04, 0.02))
    splats = replace(splats, position=splats.position + UTM)
    scene = build_scene(splats, Settings(radius=0.02, origin=UTM))
    scene = replace(scene, header=replace(scene.header, levels=(GROUP, N - GROUP), unit="foot"))
    packed = write_arrays(scene.header, scene.arrays, folder / "a.splatpress")
    return scene, export(packed, "3dtiles", folder / "a.zip")


def all_tiles(tile: dict) -> list[dict]:
    return [tile, *(below for child in tile.get("children", ()) for below in all_tiles(child))]


def bounds(tile: dict) -> tuple[np.ndarray, np.ndarray]:
    middle, half = np.split(np.array(tile["boundingVolume"]["box"]), [3])
    reach = np.abs(half.reshape(3, 3)).sum(axis=0)
    return middle - reach, middle + reach


def test_tiles__are_a_tree_of_boxes_and_errors_as_the_specification_asks(tiled):
    _, made = tiled
    with zipfile.ZipFile(made.path) as archive:
        document = json.loads(archive.read("tileset.json"))
        names = set(archive.namelist())
    assert document["asset"]["version"] == "1.1" and document["root"]["refine"] == "REPLACE"
    tiles = all_tiles(document["root"])
    assert document["geometricError"] >= document["root"]["geometricError"] > 0
    assert {tile["content"]["uri"] for tile in tiles[1:]} == names - {"tileset.json"} and len(tiles) == 7
    for tile in tiles:
        low, high = bounds(tile)
        assert (high > low).all() and len(tile["boundingVolume"]["box"]) == 12
        for child in tile.get("children", ()):
            child_low, child_high = bounds(child)
            assert (child_low >= low - 1e-9).all() and (child_high <= high + 1e-9).all()
            assert child["geometricError"] <= tile["geometricError"]
    assert all((tile["geometricError"] == 0) == ("children" not in tile) for tile in tiles)
    assert made.n_elements == N and "coarser levels" not in " ".join(made.lost)


def test_tiles__contents_are_valid_and_lie_in_their_boxes(tiled, tmp_path):
    """z up and in metres, as programs turn y up contents; together all splats of all levels."""
    scene, made = tiled
    with zipfile.ZipFile(made.path) as archive:
        archive.extractall(tmp_path)
    document = json.loads((tmp_path / "tileset.json").read_text())
    tiles, n = all_tiles(document["root"])[1:], 0
    cloud = cloud_of(scene, all_levels=True)
    for tile in tiles:
        data = (tmp_path / tile["content"]["uri"]).read_bytes()
        length = struct.unpack_from("<I", data, 12)[0]
        gltf = json.loads(data[20 : 20 + length])
        count = gltf["accessors"][0]["count"]
        view = gltf["bufferViews"][0]
        place = np.frombuffer(data, "<f4", 3 * count, 28 + length + view["byteOffset"]).reshape(-1, 3)
        first = GROUP * int(tile["content"]["uri"].removesuffix(".glb"))
        np.testing.assert_allclose(place, cloud.position[first : first + count], atol=1e-5)
        low, high = bounds(tile)
        in_metres = 0.3048 * place  # up is z in the scan, and again where tiles are drawn
        assert (in_metres >= low - 1e-6).all() and (in_metres <= high + 1e-6).all()
        n += count
    assert n == N
    complaints = complaints_of_gltf_validator(tmp_path / tiles[-1]["content"]["uri"])
    own = ("UNSUPPORTED_EXTENSION", "KHR_gaussian_splatting:")  # what the validator does not know yet
    assert not [c for c in complaints if c["code"] != own[0] and own[1] not in c["pointer"]]


def test_tiles__are_opened_by_the_tools_of_others(tiled, tmp_path):
    """All of a tileset's contents are found and read; where one is missing the same tools say so."""
    with zipfile.ZipFile(tiled[1].path) as archive:
        archive.extractall(tmp_path / "made")
        names = set(archive.namelist())
    said = upgraded_by_tiles_tools(tmp_path / "made" / "tileset.json", tmp_path / "again")
    assert "WARN" not in said and "ERROR" not in said
    assert {path.name for path in (tmp_path / "again").iterdir()} == names
    (tmp_path / "made" / "3.glb").unlink()
    assert "No input found for 3.glb" in upgraded_by_tiles_tools(tmp_path / "made" / "tileset.json", tmp_path / "less")
