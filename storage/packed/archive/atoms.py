"""The texels of a dictionary's atoms in few bytes, and back. Only the finest level is kept: the others are its means.

Each texel is told by how far it is from the median of those left, above and their gradient's end (the predictor of
LOCO-I: Weinberger, Seroussi, Sapiro, 2000), green first, red and blue by how much more they are off than green, with
models by how far the neighbours are apart and by how far green is off.
"""

from __future__ import annotations

import numpy as np

from storage.packed.archive.coder import (
    EVEN,
    READING,
    SIGNED,
    WRITING,
    begin,
    compiled,
    end,
    length_of,
    signed,
    within,
)
from storage.packed.dictionaries.levels import levels_of
from storage.packed.schema import Header

_PEAK, _SPREADS, _OFF = 127, 10, 4
_CHANNELS = np.array([1, 0, 2])
N_MODELS = 3 * _SPREADS * _OFF * SIGNED
_MOST_BYTES_A_TEXEL = 64  # 37 bits by models, of no more than 12 each


@compiled
def _code(state, data, texels):
    models = np.zeros((2, N_MODELS), np.int64)
    models[0] = EVEN
    side = texels.shape[1]
    for atom in range(len(texels)):
        for row in range(side):
            for column in range(side):
                off = 0
                for c in range(3):
                    channel = _CHANNELS[c]
                    left = texels[atom, row, column - 1, channel] if column else 0
                    above = texels[atom, row - 1, column, channel] if row else left
                    left = left if column else above
                    corner = texels[atom, row - 1, column - 1, channel] if row and column else left
                    usual = max(min(left, above), min(max(left, above), left + above - corner))
                    usual = min(max(usual + off, -_PEAK), _PEAK)
                    spread = min(length_of(max(left, above, corner) - min(left, above, corner)), _SPREADS - 1)
                    base = ((c * _SPREADS + spread) * _OFF + min(length_of(abs(off)) >> 1, _OFF - 1)) * SIGNED
                    found = signed(state, data, models, base, texels[atom, row, column, channel] - usual)
                    texels[atom, row, column, channel] = within(state, usual + found + _PEAK, 2 * _PEAK + 1) - _PEAK
                    if c == 0:
                        off = found


def pack_atoms(texels: np.ndarray) -> np.ndarray:
    """The bytes (m,) uint8 of the finest level (k, s, s, 3) int8."""
    out = np.empty(64 + _MOST_BYTES_A_TEXEL * texels.size, np.uint8)
    state = begin(WRITING, out)
    _code(state, out, texels.astype(np.int64))
    return out[: end(state, out)].copy()


def unpack_atoms(header: Header, data: np.ndarray) -> dict[str, np.ndarray]:
    """All levels of the atoms, by their names.

    Raises: ValueError where bytes are not just those of so many atoms. Any bytes may come: none beyond them are read.
    """
    size = header.atom_size
    texels = np.zeros((header.n_dictionary, size, size, 3), np.int64)
    data = np.array(data)  # loops are compiled for bytes that may be written
    state = begin(READING, data)
    _code(state, data, texels)
    if not end(state, data):
        raise ValueError(f"{len(data)} bytes of atoms that are not those of {header.n_dictionary}")
    finest = texels.astype(np.int8)
    return {f"atoms_{s}": level for s, level in zip(header.mip_sizes, levels_of(finest, header.mip_sizes), strict=True)}
