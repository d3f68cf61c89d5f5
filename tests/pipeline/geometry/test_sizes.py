"""Radii in a few bits: what is decoded is no smaller than what was encoded, and by a step larger at most."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.geometry.sizes import MOST_MEDIANS, SMALLEST, Scales, decode_sizes, encode_sizes, fit_scales
from storage.packed.schema import CHUNK, MOST_SIZES


def coded(size, radius, bits=3):
    scales = fit_scales(size, radius, bits)
    return decode_sizes(encode_sizes(size, scales), scales), scales


def steps_of(scales: Scales, n: int) -> np.ndarray:
    """The ratio of neighbouring codes of each splat's chunk, (n,)."""
    low, high = scales.step.astype(float).T
    return np.repeat(2 ** ((high - low) / 16 / (scales.cells - 1.0)), CHUNK)[:n]


@pytest.mark.parametrize("bits", [2, 3, 4])
@pytest.mark.parametrize("spread", [1.0, 1.3, 2.5])
def test_sizes__round_up_by_less_than_a_step_of_the_chunk(bits, spread):
    rng = np.random.default_rng(1)
    size = 0.02 * spread ** rng.uniform(-1, 1, 1000)
    found, scales = coded(size, 0.017, bits)
    assert (found >= size * (1 - 1e-9)).all()
    # The first code of a scale is rounded down by as much as a sixteenth of an octave.
    assert (found <= size * np.maximum(steps_of(scales, 1000), 2 ** (1 / 16)) * (1 + 1e-9)).all()


def test_sizes__of_one_size_all_are_of_it_to_a_sixteenth_of_an_octave():
    found, scales = coded(np.full(300, 0.5), 0.5)
    assert np.array_equal(found, np.full(300, 0.5)) and (scales.step == 128).all()
    found, _ = coded(np.full(300, 0.51), 0.5)
    assert len(set(found.tolist())) == 1 and 0.51 <= found[0] <= 0.51 * 2 ** (1 / 16)


def test_sizes__doubled_sizes_are_doubled_radii():
    size = 0.02 * 2 ** np.random.default_rng(3).uniform(-1, 1, 500)
    found, scales = coded(size, 0.02)
    twice = Scales(scales.step + np.uint8(16), scales.radius, scales.cells)
    np.testing.assert_allclose(decode_sizes(encode_sizes(size, scales), twice), 2 * found, rtol=1e-12)


def test_sizes__a_stray_point_does_not_coarsen_its_chunk():
    size = np.full(CHUNK, 1.0)
    size[7] = 1000.0
    found, _ = coded(size, 1.0)
    assert found[7] == pytest.approx(MOST_MEDIANS, rel=0.05)
    assert np.delete(found, 7).max() == 1.0


def test_sizes__scales_are_each_chunks_own():
    size = np.concatenate([np.full(CHUNK, 1.0), np.full(CHUNK, 100.0), np.full(3, 0.01)])
    found, scales = coded(size, 1.0)
    assert scales.step.shape == (3, 2)
    assert (found >= size * (1 - 1e-9)).all() and (found <= size * 2 ** (1 / 16)).all()


@pytest.mark.parametrize("spread", [1.0, 1.05, 1.3, 2.0, 4.0])
def test_sizes__over_quadrics_have_as_many_values_as_one_ratio_calls_for(spread):
    size = 0.02 * spread ** np.random.default_rng(1).uniform(-1, 1, (8, CHUNK))
    found, scales = coded(size.ravel(), 0.017, None)
    found = found.reshape(size.shape)
    low, high = scales.step.astype(float).T
    assert (found >= np.minimum(size, MOST_MEDIANS * np.median(size, axis=1, keepdims=True)) * (1 - 1e-9)).all()
    assert (scales.cells == np.clip(1 + np.ceil((high - low) / 1.875), 1, MOST_SIZES)).all()
    assert ((scales.cells == 1) == (spread == 1)).all()
    lowest = np.quantile(size, SMALLEST, axis=1, method="higher", keepdims=True)
    ratio = 2 ** (np.maximum(1.875, (high - low) / (MOST_SIZES - 1)) / 16)[:, None]
    assert (found <= np.maximum(size, lowest * 2 ** (1 / 16)) * ratio).all()


@given(st.lists(st.floats(1e-12, 1e15), min_size=1, max_size=300), st.floats(1e-12, 1e15), st.sampled_from([3, None]))
def test_sizes__any_sizes_make_codes_that_decode(sizes, radius, bits):
    found, scales = coded(np.array(sizes), radius, bits)
    assert np.isfinite(found).all() and (found > 0).all()
    assert (scales.step[:, 0] <= scales.step[:, 1]).all()


def test_sizes__coding_twice_changes_nothing():
    size = 0.02 * 2 ** np.random.default_rng(5).uniform(-1, 1, 700)
    found, scales = coded(size, 0.02)
    assert np.array_equal(encode_sizes(found, scales), encode_sizes(size, scales))
