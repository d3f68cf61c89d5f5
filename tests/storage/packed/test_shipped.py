"""Files that name a dictionary which ships with the program hold no atoms, and read like files that do."""

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.shipped_dictionary import learned, quantised, training
from pipeline.coding.grid import coefficients_of_texels
from storage.errors import InternalError, InvalidPackedFile
from storage.packed.archive.transcode import archive_packed, plain_packed
from storage.packed.dictionaries import shipped as module
from storage.packed.dictionaries.levels import shipped_arrays
from storage.packed.dictionaries.shipped import (
    FOLDER,
    N_ATOMS,
    NEWEST,
    STEP,
    SUFFIX,
    file_of,
    name_of,
    packed_bytes,
    shipped,
    unpacked,
    write_shipped,
)
from storage.packed.packed import PackedFile
from tests.packed_files import Case, arrays_for, header_of, write_arrays, write_packed_file

CASE = Case(dictionary_bits=12, n_dictionary=500, atom_size=16, n_turns=8, coarsest_size=4, shipped=True)


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """A folder of dictionaries of its own, which nothing has read yet."""
    monkeypatch.setattr(module, "FOLDER", tmp_path)
    shipped.cache_clear()
    yield tmp_path
    shipped.cache_clear()


def test_shipped__is_small_and_goes_into_the_wheel():
    files = list(FOLDER.glob(f"*{SUFFIX}"))
    assert file_of(NEWEST) in files and sum(path.stat().st_size for path in files) <= 300_000
    package_data = tomllib.loads(Path("pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    assert f"packed/dictionaries/*{SUFFIX}" in package_data["storage"]


def test_shipped__atoms_are_unit_vectors_as_they_are_shown():
    found = shipped()
    shown = coefficients_of_texels(found.texels.reshape(N_ATOMS, -1), 16) * found.scale[:, None]
    assert np.abs(np.linalg.norm(shown.astype(np.float64), axis=1) - 1).max() < 1e-6
    assert found.texels.min() >= -127 and not (found.texels % STEP).any()
    with pytest.raises(ValueError, match="read-only"):
        found.scale[0] = 1


@given(st.integers(1, 4), st.integers(0, 2**32 - 1))
def test_shipped__files_come_back_and_are_the_same_each_time(n, seed):
    rng = np.random.default_rng(seed)
    texels = (STEP * rng.integers(-63, 64, (n, 16, 16, 3))).astype(np.int8)
    scale = rng.uniform(1e-4, 1, n).astype(np.float32)
    data = packed_bytes(texels, scale)
    found = unpacked(data)
    assert np.array_equal(found[0], texels) and np.array_equal(found[1], scale)
    assert packed_bytes(*found) == data and name_of(*found) == name_of(texels, scale)
    with pytest.raises((ValueError, RuntimeError)):
        unpacked(data[:-1])


def test_shipped__a_file_reads_like_one_that_has_the_atoms(tmp_path):
    header = header_of(CASE)
    arrays = arrays_for(CASE, header) | shipped_arrays(header)
    own = write_arrays(replace(header, shipped=""), arrays, tmp_path / "own.splatpress")
    named = write_arrays(header, arrays, tmp_path / "named.splatpress")
    assert named.stat().st_size < own.stat().st_size - 200_000
    with PackedFile(own) as a, PackedFile(named) as b:
        of_own, of_named = a.load(), b.load()
        assert np.array_equal(a.read("atoms_8", 3, 5), b.read("atoms_8", 3, 5))
        assert a.totals().bytes == b.totals().bytes, "a GPU takes as much of either"
    assert of_own.arrays.keys() == of_named.arrays.keys()
    assert all(np.array_equal(values, of_named.arrays[name]) for name, values in of_own.arrays.items())


def test_shipped__archives_hold_no_atoms_either(tmp_path):
    plain = write_packed_file(CASE, tmp_path / "plain.splatpress")
    archive_packed(plain, tmp_path / "archive.splatpress")
    plain_packed(tmp_path / "archive.splatpress", tmp_path / "again.splatpress")
    with (
        PackedFile(plain) as a,
        PackedFile(tmp_path / "archive.splatpress") as b,
        PackedFile(tmp_path / "again.splatpress") as c,
    ):
        assert np.array_equal(a.read("atoms_16"), b.read("atoms_16"))
        assert c.header == a.header and c.n_bytes <= a.n_bytes + 64
    assert (tmp_path / "archive.splatpress").stat().st_size < plain.stat().st_size


def test_shipped__a_dictionary_that_is_not_here_is_one_line_of_words(tmp_path, elsewhere):
    path = write_packed_file(CASE, tmp_path / "a.splatpress")
    write_shipped(elsewhere, np.zeros((1, 16, 16, 3), np.int8), np.ones(1, np.float32))
    header = replace(header_of(CASE), shipped="0123456789abcdef" * 4)
    other = write_arrays(header, arrays_for(CASE, header), tmp_path / "b.splatpress")
    with pytest.raises(
        InvalidPackedFile, match="atoms of the dictionary 0123456789abcdef, which this program does not"
    ) as told:
        PackedFile(other)
    assert "\n" not in str(told.value)
    with PackedFile(path) as packed, pytest.raises(InternalError, match="install the program again"):
        packed.load()  # it should be here


def test_shipped__a_file_of_another_dictionary_is_our_own_mistake(tmp_path, elsewhere):
    _, path = write_shipped(elsewhere, np.zeros((1, 16, 16, 3), np.int8), np.ones(1, np.float32))
    path.rename(file_of(NEWEST))
    with pytest.raises(InternalError, match="atoms of the dictionary"):
        shipped()
    file_of(NEWEST).write_bytes(b"no frame")
    with pytest.raises(InternalError, match="ships with the program"):
        shipped()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"shipped": "f" * 63}, "shipped"),
        ({"shipped": NEWEST.upper()}, "shipped"),
        ({"atom_size": 8}, "shipped"),
        ({"n_dictionary": N_ATOMS + 1, "dictionary_bits": 13}, f"more than the {N_ATOMS} atoms"),
    ],
)
def test_shipped__headers_that_do_not_fit_are_refused(changes, words, tmp_path):
    header = header_of(CASE)
    wrong = replace(header, **changes)
    path = write_arrays(wrong, arrays_for(CASE, wrong), tmp_path / "a.splatpress")
    with pytest.raises(InvalidPackedFile, match=words), PackedFile(path) as packed:
        packed.load()


def test_shipped__is_made_the_same_again(tmp_path):
    made = []
    for name in ("a", "b"):
        folder = tmp_path / name
        folder.mkdir()
        rows = training(200, 3, ("chelsea", "brick"), n_leaves=1)
        path = write_shipped(folder, *quantised(learned(rows, 4, 1, 3, folder)))[1]
        made.append((path.name, path.read_bytes(), rows.shape))
    assert made[0] == made[1] and made[0][2] == (200, 768)
