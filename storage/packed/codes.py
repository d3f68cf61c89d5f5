"""Codes of one group as a word stream, and back: atom index in the low bits of an entry, weight code above it."""

from __future__ import annotations

import numpy as np

from storage.packed.bits import pack_bits, unpack_bits
from storage.packed.schema import Header


def pack_codes(
    header: Header, entry: np.ndarray, n_atoms: np.ndarray, atom: np.ndarray, weight: np.ndarray
) -> np.ndarray:
    """The words of one group's codes.

    `entry` (n,) from `rows_of`; `n_atoms` (n,); `atom` and `weight` (n, r), of which the first n_atoms count.
    """
    rank = np.arange(atom.shape[1])
    used = rank < n_atoms[:, None]
    fields = np.zeros(int(n_atoms.sum()), np.uint32)
    fields[(entry[:, None] + rank)[used]] = atom[used].astype(np.uint32) | (
        weight[used].astype(np.uint32) << np.uint32(header.dictionary_bits)
    )
    return pack_bits(fields, header.entry_bits)


def unpack_codes(
    header: Header, words: np.ndarray, first_word: np.ndarray, entry: np.ndarray, n_atoms: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Atoms and weight codes, two (n, n_ranks) int32 with zeros beyond each splat's n_atoms.

    `first_word` (n,) is the first word of each splat's group in `words`, which ends in a spare word.
    """
    rank = np.arange(header.n_ranks)
    used = rank < n_atoms[:, None]
    first_bit = first_word[:, None].astype(np.int64) * 32 + (entry[:, None] + rank) * header.entry_bits
    field = np.zeros(used.shape, np.uint32)
    field[used] = unpack_bits(words, first_bit[used], header.entry_bits)
    atom = field & np.uint32(2**header.dictionary_bits - 1)
    return atom.astype(np.int32), (field >> np.uint32(header.dictionary_bits)).astype(np.int32)
