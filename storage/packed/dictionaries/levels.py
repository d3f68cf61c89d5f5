"""Levels of atoms that follow from the finest, and the arrays of a dictionary that ships with the program."""

from __future__ import annotations

import numpy as np

from storage.packed.dictionaries.shipped import shipped
from storage.packed.schema import MIP_SIZES, Header


def levels_of(finest: np.ndarray, sizes: tuple[int, ...]) -> list[np.ndarray]:
    """Levels of sizes of MIP_SIZES, the finest first: means of its texels, rounded, halves to the even number."""
    assert set(sizes) <= set(MIP_SIZES)
    levels = []
    for s in sizes:
        factor = finest.shape[1] // s
        mean = finest.reshape(-1, s, factor, s, factor, 3).mean(axis=(2, 4))
        levels.append(np.round(mean).astype(np.int8))
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
