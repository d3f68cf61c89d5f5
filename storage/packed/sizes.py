"""Size codes in words: every chunk has whole words of its own, the same number, so no table tells where they begin."""

from __future__ import annotations

import numpy as np

from storage.packed.schema import CHUNK

WORD_BITS = 32


def pack_sizes(code: np.ndarray, bits: int) -> np.ndarray:
    """The words (c, CHUNK bits / 32) uint32 of codes (n,) below 2^bits, a field after the other, lowest bit first; the last chunk
    is filled up with zeros."""
    padded = np.pad(code.astype(np.uint8), (0, -len(code) % CHUNK)).reshape(-1, CHUNK)
    field = (padded[:, :, None] >> np.arange(bits, dtype=np.uint8)) & 1
    return np.packbits(field.reshape(len(padded), -1), axis=1, bitorder="little").view("<u4")


def unpack_sizes(words: np.ndarray, bits: int, n_splats: int) -> np.ndarray:
    """The codes (n_splats,) uint8 of what `pack_sizes` made."""
    field = np.unpackbits(np.ascontiguousarray(words, "<u4").view(np.uint8), axis=1, bitorder="little")
    return (field.reshape(-1, bits) << np.arange(bits, dtype=np.uint8)).sum(axis=1, dtype=np.uint8)[:n_splats]
