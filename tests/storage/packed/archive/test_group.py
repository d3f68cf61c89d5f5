"""Groups of a file in archive form: numbers of any size come back, and bytes that are something else are refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from storage.packed.archive.atoms import levels_of, pack_atoms, unpack_atoms
from storage.packed.archive.coder import (
    EVEN,
    READING,
    SIGNED,
    WRITING,
    begin,
    end,
    even,
    share,
    signed,
    tree,
)
from storage.packed.archive.continued import looks_of
from storage.packed.archive.group import code_group, group_models, unpack_group
from storage.packed.archive.mixing import (
    MOST_PLACES,
    N_BASES,
    SIGNED_SETS,
    TREE_SETS,
    fresh_models,
    mixed_signed,
    mixed_tree,
)
from storage.packed.packed import PackedFile
from tests.packed_files import Case, header_of, write_packed_file

CASE = Case(n_turns=8, cliplines=True, ellipsoids=True, size_bits=3, color_step=100, period=50, n_splats=200)


CODERS = (
    lambda state, data, models, value: tree(state, data, models, 0, 7, value),
    lambda state, data, models, value: signed(state, data, models, 128, value),
    lambda state, data, models, value: even(state, data, 33, value),
    lambda state, data, models, value: share(state, data, 1, 3, value),
)


def coded(mode: int, data: np.ndarray, numbers: list[tuple[int, int]]) -> tuple[list[int], int]:
    models = np.zeros((2, 128 + SIGNED), np.int64)
    models[0] = EVEN
    state = begin(mode, data)
    return [CODERS[kind](state, data, models, value) for kind, value in numbers], end(state, data)


NUMBERS = st.one_of(
    st.tuples(st.just(0), st.integers(0, 127)),
    st.tuples(st.just(1), st.integers(-(2**34) + 1, 2**34 - 1)),
    st.tuples(st.just(1), st.integers(-4, 4)),
    st.tuples(st.just(2), st.integers(0, 2**33 - 1)),
    st.tuples(st.just(3), st.integers(0, 1)),
)


@settings(max_examples=80, deadline=None)
@given(st.lists(NUMBERS, max_size=60))
def test_coder__numbers_come_back_from_just_as_many_bytes(numbers):
    values = [value for _, value in numbers]
    data = np.zeros(16 + 64 * len(values), np.uint8)
    found, n = coded(WRITING, data, numbers)
    assert found == values
    unknown = [(kind, 0) for kind, _ in numbers]
    assert coded(READING, data[:n].copy(), unknown) == (values, 1)
    assert coded(READING, np.append(data[:n], np.uint8(0)), unknown) == (values, 0)  # a byte too many


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(-(2**34) + 1, 2**34 - 1) | st.integers(-3, 3), max_size=60), st.integers(1, MOST_PLACES))
def test_mixed__numbers_come_back_by_any_number_of_models(values, n):
    def coded_by(mode, data, given_):
        models, bases = (
            fresh_models(MOST_PLACES * SIGNED + 16, SIGNED_SETS + TREE_SETS),
            SIGNED * np.arange(N_BASES),
        )
        state, found = begin(mode, data), []
        for value in given_:
            found.append(mixed_signed(state, data, *models.pair, bases, n, 0, value))
            low = mixed_tree(state, data, *models.pair, bases + 1, n, SIGNED_SETS, 3, abs(value) & 7)
            assert low == abs(found[-1]) & 7
        return found, end(state, data)

    data = np.zeros(16 + 64 * len(values), np.uint8)
    found, size = coded_by(WRITING, data, values)
    assert found == values
    assert coded_by(READING, data[:size].copy(), [0] * len(values)) == (values, 1)


def test_mixed__tables_are_the_same_on_any_machine():
    """No entry is within a billionth of where it would be rounded the other way."""
    x, y = np.arange(-2048, 2048) / 256, np.append(0.5, np.arange(1.0, 4096))
    for exact in (4096 / (1 + np.exp(-x)), 256 * np.log(y / (4096 - y))):
        assert np.abs(np.abs(exact - np.floor(exact)) - 0.5).min() > 1e-9


@pytest.fixture(scope="module", params=[False, True], ids=["boxes", "quadrics"])
def group(request, tmp_path_factory):
    """The scene of a group of one file, its arrays, and its bytes."""
    case = Case(**(CASE.__dict__ | {"quadrics": request.param}))
    with PackedFile(write_packed_file(case, tmp_path_factory.mktemp("group") / "a.splatpress")) as opened:
        scene, arrays, looks = opened.group(0), opened.rows_of_group(0), looks_of(opened.header, opened.of_all())
    n_rows = {name: len(values) for name, values in arrays.items()}
    return scene, n_rows, looks, np.append(np.uint8(0), code_group(scene, group_models(scene.header), looks))


def test_group__bytes_that_are_cut_or_longer_are_refused(group):
    scene, n_rows, looks, data = group
    for kind in (0, 1):
        data = np.append(np.uint8(kind), data[1:])
        for n in [*range(40), len(data) // 2, len(data) - 1]:
            with pytest.raises(ValueError):
                unpack_group(scene.header, data[:n], n_rows, None, looks)
        with pytest.raises(ValueError):
            unpack_group(scene.header, np.append(data, np.uint8(0)), n_rows, None, looks)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_group__any_bytes_are_a_group_or_refused(group, data):
    scene, n_rows, looks, sound = group
    drawn = data.draw(
        st.one_of(
            st.binary(max_size=300).map(lambda b: np.frombuffer(b"\0" + b, np.uint8)),
            st.binary(max_size=300).map(lambda b: np.frombuffer(b"\1" + b, np.uint8)),
            st.tuples(st.integers(1, len(sound) - 1), st.integers(1, 255)).map(lambda at: _changed(sound, *at)),
            st.integers(0, 255).map(lambda byte: np.append(np.uint8(0), np.full(4000, byte, np.uint8))),
        )
    )
    try:
        arrays = unpack_group(scene.header, drawn, n_rows, None, looks)
    except ValueError:
        return
    assert arrays["batch_count"].sum() == scene.header.n_splats


def _changed(data: np.ndarray, at: int, by: int) -> np.ndarray:
    data = data.copy()
    data[at] ^= by
    return data


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 8, 300]))
def test_atoms__come_back_with_their_levels_and_other_bytes_are_refused(seed, spread):
    rng = np.random.default_rng(seed)
    texels = np.clip(rng.normal(0, spread, (3, 8, 8, 3)), -127, 127).astype(np.int8)
    header = header_of(Case(atom_size=8, n_dictionary=3))
    data = pack_atoms(texels)
    found = unpack_atoms(header, data)
    assert list(found) == ["atoms_8", "atoms_4", "atoms_2", "atoms_1"]
    for level, wanted in zip(found.values(), levels_of(texels, (8, 4, 2, 1)), strict=True):
        assert np.array_equal(level, wanted)
    assert np.array_equal(found["atoms_8"], texels)
    for broken in (data[:-1], np.append(data, np.uint8(0)), data[:0]):
        with pytest.raises(ValueError):
            unpack_atoms(header, broken)
