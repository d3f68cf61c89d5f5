"""Levels of atoms that follow from the finest, and the arrays of a dictionary that ships with the program."""

from __future__ import annotations

import numpy as np

from storage.packed.dictionaries.shipped import shipped
from storage.packed.schema import MIP_SIZES, Header

_ROWS = 1024  # atoms at a time: what is made on the way takes 8 times the bytes of their texels


def levels_of(finest: np.ndarray, sizes: tuple[int, ...]) -> list[np.ndarray]:
    """Levels (k, s, s, 3) int8 of sizes of MIP_SIZES of the finest (k, s, s, 3) int8, which comes first: means of its
    texels, rounded, halves to the even number."""
    assert set(sizes) <= set(MIP_SIZES)
    levels = [np.empty((len(finest), s, s, 3), np.int8) for s in sizes]
    for start in range(0, len(finest), _ROWS):
        rows = slice(start, start + _ROWS)
        for level, s in zip(levels, sizes, strict=True):
            factor = finest.shape[1] // s
            level[rows] = np.round(finest[rows].reshape(-1, s, factor, s, factor, 3).mean(axis=(2, 4)))
    return levels


def shipped_arrays(header: Header) -> dict[str, np.ndarray]:
    """What a file that names a dictionary lacks of it, by the names of arrays: all levels of its atoms, their scales.

    Raises: ValueError where the file has more atoms than the dictionary; InternalError where that is broken.
    """
    found, n = shipped(header.shipped), header.n_dictionary
    if n > len(found.texels):
        raise ValueError(f"n_dictionary {n}, more than the {len(found.texels)} atoms of {header.shipped[:16]}")
    levels = levels_of(found.texels[:n], header.mip_sizes)
    arrays = {f"atoms_{size}": level for size, level in zip(header.mip_sizes, levels, strict=True)}
    return {"atom_scale": found.scale[:n]} | arrays
