"""Average colours in boxes as a word stream: every chunk begins a word, and its splats have as many bits as its box
takes."""

from __future__ import annotations

import numpy as np

from storage.packed.bits import pack_bits, unpack_bits
from storage.packed.schema import CHUNK


def color_words(n_splats: int, bits: np.ndarray) -> np.ndarray:
    """Words of each chunk, (c,) int64, of `n_splats` consecutive splats with `bits` (c,) each."""
    n = np.minimum(CHUNK, n_splats - CHUNK * np.arange(len(bits)))
    return -(-n * bits // 32)


def pack_colors(code: np.ndarray, bits: np.ndarray) -> list[np.ndarray]:
    """The words of each chunk, of cells (n,) with `bits` (c,) each."""
    nothing = np.zeros(0, np.uint32)
    return [pack_bits(code[i * CHUNK : (i + 1) * CHUNK], int(b)) if b else nothing for i, b in enumerate(bits)]


def unpack_colors(words: np.ndarray, first_word: np.ndarray, bits: np.ndarray, n_splats: int) -> np.ndarray:
    """The cells (n,) uint32 that `pack_colors` packed; `first_word` (c,) of each chunk in `words`, which end in a spare
    word."""
    code = np.zeros(n_splats, np.uint32)
    chunk, place = np.divmod(np.arange(n_splats), CHUNK)
    for width in np.unique(bits[bits > 0]).tolist():
        rows = np.flatnonzero(bits[chunk] == width)
        code[rows] = unpack_bits(words, 32 * first_word[chunk[rows]].astype(np.int64) + place[rows] * width, width)
    return code
