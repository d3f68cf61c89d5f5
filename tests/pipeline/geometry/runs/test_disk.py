"""Codes of runs in bytes: back without loss, smaller than they were, and hostile bytes end in an error or in codes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.geometry.runs.codes import RunCodes
from pipeline.geometry.runs.disk import pack_runs, unpack_runs
from tests.pipeline.geometry.runs.test_codes import coded  # noqa: F401 (a fixture)

HYPOTHESIS = {"deadline": None, "derandomize": True, "database": None, "max_examples": 100}


@st.composite
def any_codes(draw) -> RunCodes:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n = draw(st.sampled_from([1, 2, 40, 700]))
    start = (
        rng.integers(0, 2**32, n, dtype=np.uint32)
        if draw(st.booleans())
        else np.full(n, draw(st.integers(0, 2**32 - 1)), np.uint32)
    )
    n_steps = int((start >> 27).sum())
    normal = rng.integers(-127, 128, (n, 2)).astype(np.int8)
    step = (rng.integers(0, draw(st.sampled_from([1, 6])), n_steps) | rng.integers(0, 32, n_steps) << 3).astype(
        np.uint8
    )
    return RunCodes(
        np.zeros((1, 3), np.int32),
        np.zeros(1, np.uint32),
        np.zeros(1, np.uint32),
        start,
        normal,
        step,
        np.zeros((32, 2), np.int8),
    )


@settings(**HYPOTHESIS)
@given(any_codes())
def test_disk__comes_back_bit_by_bit(codes):
    start, normal, step = unpack_runs(pack_runs(codes), len(codes.start), len(codes.step))
    assert (
        np.array_equal(start, codes.start) and np.array_equal(normal, codes.normal) and np.array_equal(step, codes.step)
    )


def test_disk__is_smaller_by_a_fifth_and_more(coded):  # noqa: F811
    _, _, codes, _ = coded
    data = pack_runs(codes)
    assert len(data) < 0.8 * (codes.start.nbytes + codes.normal.nbytes + codes.step.nbytes)


def test_disk__bytes_of_something_else_end_in_an_error_or_in_codes(coded):  # noqa: F811
    _, _, codes, _ = coded
    data, n = pack_runs(codes), len(codes.start)
    rng = np.random.default_rng(0)
    for broken in (
        data[:0],
        data[: len(data) // 2],
        rng.integers(0, 256, 5000).astype(np.uint8),
        np.full(900, 255, np.uint8),
    ):
        with pytest.raises(ValueError, match="other runs"):
            unpack_runs(broken, n, len(codes.step))
    with pytest.raises(ValueError, match="other runs"):
        unpack_runs(data, n, len(codes.step) - 1)
