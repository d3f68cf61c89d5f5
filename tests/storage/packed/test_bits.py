import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from storage.packed.bits import pack_bits, unpack_bits, words_for
from tests.reference_packed import read_field

WIDTHS = st.integers(1, 32)


@st.composite
def fields(draw):
    width = draw(WIDTHS)
    return width, np.array(draw(st.lists(st.integers(0, 2**width - 1), max_size=70)), np.uint64)


@settings(deadline=None, derandomize=True, max_examples=100)
@given(fields())
def test_bits__every_field_comes_back(case):
    width, values = case
    words = np.append(pack_bits(values, width), np.uint32(0))
    assert (unpack_bits(words, np.arange(len(values)) * width, width) == values).all()


@settings(deadline=None, derandomize=True, max_examples=100)
@given(fields())
def test_bits__fields_lie_lowest_bit_first(case):
    width, values = case
    words = pack_bits(values, width)
    assert [read_field(words, i * width, width) for i in range(len(values))] == values.tolist()


@settings(deadline=None, derandomize=True, max_examples=100)
@given(fields())
def test_bits__stream_is_as_short_as_it_can_be(case):
    width, values = case
    n_words = len(pack_bits(values, width))
    assert n_words == words_for(len(values), width)
    assert 32 * (n_words - 1) < len(values) * width <= 32 * n_words


@settings(deadline=None, derandomize=True, max_examples=50)
@given(fields(), st.integers(0, 2**32 - 1))
def test_bits__spare_word_is_loaded_but_never_counts(case, spare):
    width, values = case
    words = np.append(pack_bits(values, width), np.uint32(spare))
    assert (unpack_bits(words, np.arange(len(values)) * width, width) == values).all()


def test_bits__bits_beyond_the_last_field_are_zero():
    assert pack_bits(np.array([4095, 4095, 4095]), 12).tolist() == [0xFFFFFFFF, 0xF]


@pytest.mark.parametrize("width", [1, 12, 24, 32])
def test_bits__no_fields_are_no_words(width):
    assert pack_bits(np.zeros(0, np.uint32), width).shape == (0,)
    assert unpack_bits(np.zeros(1, np.uint32), np.zeros(0, np.int64), width).shape == (0,)


def test_bits__offsets_beyond_32_bits_are_kept():
    words = np.zeros(4, np.uint32)
    words[2] = 0xABC
    far = np.array([64], np.int64) + (1 << 40)
    with pytest.raises(IndexError):
        unpack_bits(words, far, 12)  # a wrap to 32 bits would find 0xABC here
    assert unpack_bits(words, np.array([64]), 12).tolist() == [0xABC]
