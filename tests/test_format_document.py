"""docs/FORMAT.md says what storage/packed/schema.py says, and its example works."""

import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import zarr
from zarr.storage import ZipStore

from storage.packed import schema
from storage.packed.layout import ATOMS_PER_ZARR_CHUNK, TABLE_ROWS_PER_ZARR_CHUNK
from storage.packed.packed import PackedFile
from storage.packed.schema import (
    ARRAYS,
    CHUNK,
    CLIPLINE_BITS,
    ELLIPSOID_FIELD_BITS,
    ELLIPSOID_FIELDS,
    GROUP,
    MIP_SIZES,
    Camera,
    Header,
)
from storage.packed.seal import SEAL_BYTES
from tests.packed_files import Case, write_packed_file
from tests.reference_packed import decode_patch

TEXT = (Path(__file__).parent.parent / "docs" / "FORMAT.md").read_text()


def table(section: str) -> list[list[str]]:
    """The rows of the first table of a section, as lists of cells."""
    body = TEXT.split(f"\n## {section}\n")[1].split("\n## ")[0]
    rows = [line.strip("|").split("|") for line in body.splitlines() if line.startswith("|")]
    return [[cell.strip().strip("`*") for cell in row] for row in rows[2:]]


def test_format__names_exactly_the_arrays_of_the_schema():
    written = [(name, tuple(dims.split(", ")), dtype) for name, dims, dtype, _ in table("Arrays")]
    assert sorted(written) == sorted((array.name, array.dims, array.dtype) for array in ARRAYS)


def test_format__names_exactly_the_fields_of_the_header():
    assert [row[0] for row in table("Header")] == ["format", "version", *(field.name for field in fields(Header))]
    cameras = next(row[2] for row in table("Header") if row[0] == "cameras")
    assert re.findall(r"`(\w+)`", "`" + cameras + "`") == [field.name for field in fields(Camera)]


def test_format__states_the_version_that_is_written():
    assert TEXT.startswith(f"# The packed file, version {schema.FORMAT_VERSION}\n")
    assert table("Header")[1] == ["version", "integer", str(schema.FORMAT_VERSION)]


def test_format__states_the_sizes_of_the_code():
    for sentence in (
        f"{CHUNK} consecutive splats are",
        f"{GROUP} consecutive splats, so {GROUP // CHUNK} chunks",
        f"`n` at {GROUP:,} splats, `c` at {GROUP // CHUNK} chunks and streams at one group",
        f"the table of groups at {TABLE_ROWS_PER_ZARR_CHUNK:,} groups, `k` at {ATOMS_PER_ZARR_CHUNK} atoms",
        f"the last {SEAL_BYTES} bytes",
        f"one {CLIPLINE_BITS}-bit field",
    ):
        assert sentence in TEXT, sentence


def test_format__bits_a_splat_add_up():
    rows = {row[0]: row[1] for row in table("Size")}
    box_bits = 8 * (3 * 4 + 3 * 4 + 4) / CHUNK
    without = float(rows["position"]) + float(rows["normal"]) + box_bits
    assert rows["chunk box"].startswith(f"{box_bits}:")
    assert float(rows["geometry without a clipline"]) == without == 41.75
    assert float(rows["geometry with a clipline"]) == without + CLIPLINE_BITS == 53.75
    assert float(rows["geometry of an ellipsoid"]) == without + ELLIPSOID_FIELDS * ELLIPSOID_FIELD_BITS == 73.75
    assert f"{3 * sum(size * size for size in MIP_SIZES)} bytes an atom" in TEXT


@pytest.mark.parametrize(
    "case",
    [
        Case(n_splats=GROUP + 300, cliplines=True, period=128),
        Case(dictionary_bits=16, weight_bits=8, n_dictionary=300),
        Case(dictionary_bits=12, n_dictionary=300),
        Case(dictionary_bits=12, n_dictionary=300, atom_size=8, n_turns=8),
        Case(n_splats=GROUP + 300, period=128, atom_counts=(0, 5, 16), n_ranks=16, color_step=112),
        Case(color_step=80),
    ],
)
def test_format__its_example_decodes_single_patches(case, tmp_path):
    example = {}
    exec(re.search(r"```python\n(.*?)```", TEXT, re.DOTALL)[1], example)
    path = write_packed_file(case, tmp_path / "a.splatpress")
    with PackedFile(path) as packed:
        scene = packed.load()
    with ZipStore(path, mode="r") as store:
        opened = zarr.open_group(store, mode="r")
        for splat in (0, 1, 127, 128, 200, case.n_splats // 2, case.n_splats - 1):
            for size in (32, 8, 4):
                expected = decode_patch(scene, splat, size).clip(0, 1)
                np.testing.assert_allclose(example["patch"](opened, splat, size), expected, atol=1e-5)
