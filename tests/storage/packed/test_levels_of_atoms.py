"""Mip levels of atoms follow from the finest."""

from __future__ import annotations

import numpy as np

from storage.packed.dictionaries.levels import levels_of
from storage.packed.schema import MIP_SIZES


def test_levels__are_means_down_to_one_texel():
    texels = np.random.default_rng(1).integers(-127, 128, (4, 3072)).astype(np.int8)
    levels = levels_of(texels.reshape(4, 32, 32, 3), MIP_SIZES)
    assert [level.shape for level in levels] == [(4, s, s, 3) for s in MIP_SIZES]
    assert (levels[0].reshape(4, -1) == texels).all()
    full = levels[0].astype(float)
    for size, level in zip(MIP_SIZES, levels):
        block = 32 // size
        corner = full[:, :block, -block:].mean(axis=(1, 2))
        assert np.abs(level[:, 0, -1] - corner).max() <= 0.5 + 1e-9
