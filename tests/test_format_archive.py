"""docs/FORMAT.md is enough to read files in archive form: the decoder made from the page alone against the product."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest

from storage.packed.archive.columns import axis_of_heights, chunks_of, splats_of
from storage.packed.archive.continued import looks_of
from storage.packed.archive.group import code_group, group_models
from storage.packed.archive.splats import BATCH, CAMERA, ELLIPSOID, HEIGHT, LINE, RED, SIZE, STATION, A, B
from storage.packed.packed import PackedFile
from tests import format_archive
from tests.format_archive import decode_group
from tests.packed_files import Case, write_packed_file

CASES = [
    Case(cliplines=True, period=40),
    Case(n_splats=129, quadrics=True, cliplines=True, ellipsoids=True, size_bits=3, color_step=100, atom_size=8),
    Case(n_dictionary=0, atom_counts=(0,), n_cameras=0, n_maps=2, size_bits=3, period=50),
    Case(n_splats=200, n_turns=8, n_dictionary=19, cliplines=True, size_bits=3, color_step=100),
    Case(n_splats=130, n_turns=8, n_dictionary=19, atom_size=8, quadrics=True, size_bits=4, period=37),
    Case(n_splats=140, ellipsoids=True, dictionary_bits=12, weight_bits=6, n_dictionary=300, color_step=112),
]


def test_format_archive__knows_nothing_of_the_product():
    tree = ast.parse(Path(format_archive.__file__).read_text())
    names = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert names | {a.name for node in ast.walk(tree) if isinstance(node, ast.Import) for a in node.names} == {
        "__future__",
        "math",
        "numpy",
        "tests.format_textures",
    }


@pytest.mark.parametrize("case", CASES)
def test_format_archive__decodes_what_the_product_wrote(case, tmp_path):
    with PackedFile(write_packed_file(case, tmp_path / "a.splatpress")) as opened:
        scene, shared = opened.group(0), opened.of_all("dictionary")
    header = scene.header
    data = b"\0" + code_group(scene, group_models(header), looks_of(header, shared)).tobytes()
    size, told = f"atoms_{header.atom_size}", header.to_json() | {"cameras": list(header.cameras)}
    dictionary = (shared[size], shared["atom_scale"], shared["weight_levels"]) if size in shared else None
    tables, found = decode_group(told, data, header.n_splats, dictionary)
    for name, rows in tables.items():
        values = scene.arrays[name].reshape(header.n_chunks, -1)
        assert rows == (values.view(np.uint32) if values.dtype == np.float32 else values).tolist(), name
    assert sorted(map(_told, found)) == sorted(_wanted(scene))


def _told(splat: dict) -> tuple:
    word = sum(x << 4 * i for i, x in enumerate(splat.get("clipline", [])))
    ellipsoid = sum(x << 8 * i for i, x in enumerate(splat.get("ellipsoid", [])))
    colors = tuple(splat[f"color{f}"] for f in range(3))
    fields = splat["height"], splat["a"], splat["b"], splat["batch"], splat.get("size", 0), *colors
    return (*fields, splat.get("camera", 0), splat.get("station", 0), word, ellipsoid, tuple(splat["atoms"]))


def _wanted(scene) -> list[tuple]:
    boxes = scene.header.geometry == "boxes"
    axis = axis_of_heights(scene) if boxes else np.zeros(scene.header.n_chunks, np.int64)
    chunks, _ = chunks_of(scene.header, scene.arrays, axis)
    s = splats_of(scene, chunks)
    columns = [HEIGHT, A, B, BATCH, SIZE, RED, RED + 1, RED + 2, CAMERA, STATION, LINE, ELLIPSOID]
    counts = scene.n_atoms
    atoms = [tuple(map(tuple, s.entries[f : f + n].tolist())) for f, n in zip(s.first, counts)]
    return [(*map(int, row), a) for row, a in zip(s.fields[:, columns], atoms)]
