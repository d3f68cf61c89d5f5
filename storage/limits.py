"""Sizes and limits of the packed file that knobs have too: the command line knows them before numpy could be
imported."""

from __future__ import annotations

MAX_ATOMS = 16  # a splat
ATOM_SIZES = (32, 16, 8)  # texels to a side
MOST_LEVELS = 6  # beside the finest
