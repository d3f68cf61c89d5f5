"""Codes of runs in bytes: back without loss, small, and hostile bytes end in an error or in runs of as many cells."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from storage.packed.runs.coded import GroupRuns, pack_runs, unpack_runs
from storage.packed.runs.tables import MOST_INDEX, most_bytes
from storage.packed.schema import MOST_RUNS
from tests.packed_files import Case, arrays_for, header_of

HYPOTHESIS = {"deadline": None, "derandomize": True, "database": None, "max_examples": 60}


def same(a: GroupRuns, b: GroupRuns) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in GroupRuns.__dataclass_fields__)


@st.composite
def any_runs(draw) -> GroupRuns:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n = draw(st.sampled_from([1, 2, 40, 700]))
    start = rng.integers(0, 2**32, n, dtype=np.uint32)
    if draw(st.booleans()):
        start[:] = draw(st.integers(0, 2**32 - 1))
    first = np.unique([0, *rng.integers(0, n, draw(st.integers(0, 9))), *range(0, n, MOST_RUNS)]).astype(np.uint32)
    n_steps = int((start >> 27).sum())
    step = rng.integers(0, draw(st.sampled_from([1, 6])), n_steps) | rng.integers(0, 32, n_steps) << 3
    base = rng.integers(-MOST_INDEX, MOST_INDEX + 1, (len(first), 3)).astype(np.int32)
    return GroupRuns(base, first, start, rng.integers(-127, 128, (n, 2)).astype(np.int8), step.astype(np.uint8))


@settings(**HYPOTHESIS)
@given(any_runs())
def test_run_codes__come_back_bit_by_bit_within_their_bound(runs):
    n = len(runs.start) + len(runs.step)
    data = pack_runs(runs)
    assert len(data) <= most_bytes(n) and same(unpack_runs(data, n), runs)


@pytest.fixture(scope="module")
def walked() -> tuple[GroupRuns, np.ndarray]:
    """Straight runs side by side, as on a plane, and their bytes."""
    start = np.array([5 * r | r << 11 | 24 << 27 for r in range(40)], np.uint32)
    runs = GroupRuns(
        np.zeros((1, 3), np.int32), np.zeros(1, np.uint32), start, np.zeros((40, 2), np.int8), np.zeros(960, np.uint8)
    )
    return runs, pack_runs(runs)


def test_run_codes__of_a_plane_take_less_than_a_bit_a_cell(walked):
    assert 8 * len(walked[1]) < 1000


def test_run_codes__of_noise_take_little_more_than_its_bits():
    arrays = arrays_for(case := Case(n_splats=4000, atom_counts=(0,), runs=True), header_of(case))
    runs = GroupRuns(*(arrays[f"run_{name}"] for name in GroupRuns.__dataclass_fields__))
    in_bits = 32 * len(runs.start) + 16 * len(runs.start) + np.log2(6 * 32) * len(runs.step)
    assert 8 * len(pack_runs(runs)) < 1.12 * in_bits


def test_run_codes__that_are_cut_longer_or_of_other_cells_are_refused(walked):
    runs, data = walked
    rng = np.random.default_rng(0)
    for broken in (data[:0], data[:-1], np.append(data, np.uint8(0)), rng.integers(0, 256, 5000).astype(np.uint8)):
        with pytest.raises(ValueError, match="not those of 1000 cells"):
            unpack_runs(broken, 1000)
    for n in (1, 999, 1001):
        with pytest.raises(ValueError, match=f"not those of {n} cells"):
            unpack_runs(data, n)


def test_run_codes__of_any_bytes_are_an_error_or_runs_of_as_many_cells(walked):
    data, found = walked[1], 0
    for at in range(len(data)):
        for value in (data[at] ^ 1, data[at] ^ 128):
            broken = data.copy()
            broken[at] = value
            try:
                runs = unpack_runs(broken, 1000)
            except ValueError:
                continue
            found += 1
            assert len(runs.start) + len(runs.step) == 1000 and int((runs.start >> 27).sum()) == len(runs.step)
    assert found < len(data)
