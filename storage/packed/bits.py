"""Fields of a fixed number of bits in a stream of 32-bit words, lowest bit first; and sizes, of which every chunk has
whole words.

The shader reads the same stream with the same two loads (renderer/shaders/bits.glsl). Every stream ends in one spare
word, so that the second load never leaves it.
"""

from __future__ import annotations

import numpy as np

from storage.packed.schema import CHUNK


def words_for(n_fields: int, width: int) -> int:
    """How many words `n_fields` fields of `width` bits take, without the spare word."""
    return -(-n_fields * width // 32)


def pack_bits(values: np.ndarray, width: int) -> np.ndarray:
    """The stream of `values` (n,), each below 2^width, width at most 32; returns (words_for(n, width),) uint32."""
    position = np.arange(len(values), dtype=np.int64) * width
    word, shift = position >> 5, (position & 31).astype(np.uint64)
    shifted = values.astype(np.uint64) << shift
    words = np.zeros(words_for(len(values), width) + 1, np.uint32)
    np.bitwise_or.at(words, word, (shifted & np.uint64(0xFFFFFFFF)).astype(np.uint32))
    np.bitwise_or.at(words, word + 1, (shifted >> np.uint64(32)).astype(np.uint32))
    return words[:-1]


def unpack_bits(words: np.ndarray, first_bit: np.ndarray, width: int) -> np.ndarray:
    """The fields of `width` bits that begin at the bits `first_bit` (n,); returns (n,) uint32.

    `words` must hold one word beyond each field's first.
    """
    word, shift = first_bit >> 5, (first_bit & 31).astype(np.uint64)
    both = words[word].astype(np.uint64) | words[word + 1].astype(np.uint64) << np.uint64(32)
    return ((both >> shift) & np.uint64(2**width - 1)).astype(np.uint32)


def pack_sizes(code: np.ndarray, bits: int) -> np.ndarray:
    """The words (c, CHUNK bits / 32) uint32 of codes (n,) below 2^bits, a field after the other, lowest bit first; the
    last chunk is filled up with zeros."""
    padded = np.pad(code.astype(np.uint8), (0, -len(code) % CHUNK)).reshape(-1, CHUNK)
    field = (padded[:, :, None] >> np.arange(bits, dtype=np.uint8)) & 1
    return np.packbits(field.reshape(len(padded), -1), axis=1, bitorder="little").view("<u4")


def unpack_sizes(words: np.ndarray, bits: int, n_splats: int) -> np.ndarray:
    """The codes (n_splats,) uint8 of what `pack_sizes` made."""
    field = np.unpackbits(np.ascontiguousarray(words, "<u4").view(np.uint8), axis=1, bitorder="little")
    return (field.reshape(-1, bits) << np.arange(bits, dtype=np.uint8)).sum(axis=1, dtype=np.uint8)[:n_splats]
