"""Readers of zarr that others wrote open packed files: tensorstore and zarrita.js (zarr-python is what storage
uses)."""

import numpy as np
import pytest

from storage.packed.packed import PackedFile
from storage.packed.schema import GROUP, arrays_of
from tests.packed_files import Case, write_packed_file
from tests.programs_of_others import read_by_zarrita

CASES = [Case(n_splats=GROUP + 300, cliplines=True, period=128), Case(color_step=112, ellipsoids=True)]


@pytest.mark.parametrize("case", CASES)
def test_packed__every_array_opens_in_tensorstore(case, tmp_path):
    tensorstore = pytest.importorskip("tensorstore")
    path = write_packed_file(case, tmp_path / "a.splatpress")
    with PackedFile(path) as packed:
        for name in (array.name for array in arrays_of(packed.header)):
            store = {"driver": "zip", "base": path.as_uri(), "path": f"{name}/"}
            found = np.asarray(tensorstore.open({"driver": "zarr3", "kvstore": store}).result().read().result())
            expected = packed.read(name)
            assert found.dtype == expected.dtype and np.array_equal(found, expected), name


@pytest.mark.parametrize("case", CASES)
def test_packed__arrays_open_in_zarrita(case, tmp_path):
    path = write_packed_file(case, tmp_path / "a.splatpress")
    with PackedFile(path) as packed:
        for name in ("position", "normal", "box_low", "codes", "atoms_8", "camera"):
            found, expected = read_by_zarrita(path, name), packed.read(name)
            assert found["attributes"]["n_splats"] == case.n_splats
            np.testing.assert_array_equal(np.reshape(found["values"], found["shape"]), expected)
