"""Size codes in words: every code comes back, each chunk has whole words, and fields lie where the page says."""

import numpy as np
import pytest

from storage.packed.bits import pack_sizes, unpack_sizes
from storage.packed.schema import CHUNK, SIZE_BITS
from tests.reference_packed import read_field


@pytest.mark.parametrize("n", [1, CHUNK - 1, CHUNK, 3 * CHUNK + 5])
@pytest.mark.parametrize("bits", [bits for bits in SIZE_BITS if bits])
def test_sizes__come_back_and_a_chunk_has_whole_words(bits, n):
    code = np.random.default_rng(n).integers(0, 2**bits, n).astype(np.uint8)
    words = pack_sizes(code, bits)
    assert words.shape == (-(-n // CHUNK), CHUNK * bits // 32) and words.dtype == np.dtype("<u4")
    assert np.array_equal(unpack_sizes(words, bits, n), code)


@pytest.mark.parametrize("bits", [bits for bits in SIZE_BITS if bits])
def test_sizes__field_i_begins_at_bit_i_of_so_many(bits):
    code = np.random.default_rng(bits).integers(0, 2**bits, 2 * CHUNK).astype(np.uint8)
    words = pack_sizes(code, bits)
    for i in range(len(code)):
        chunk, place = divmod(i, CHUNK)
        assert read_field(np.append(words[chunk], 0), place * bits, bits) == code[i]
