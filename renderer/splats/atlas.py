"""The dictionary as one texture: the mip levels of the packed file as bands, one below the other.

A band is the level's atoms side by side, row after row. A texture array would not do, since drivers end at 2048 layers.
GL's own mip levels would, in the same bytes; but fetches at a level that differs from splat to splat cost llvmpipe a
quarter more of a frame (4 atoms a splat, 1536x1024 px: 2.8 against 2.2 CPU seconds), and bands are all read at level 0.
Signed bytes stay signed bytes (RGB8_SNORM): a byte b
is read as b / 127.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, sqrt

import moderngl
import numpy as np

from storage.errors import ResourceExhausted
from storage.packed.schema import MIP_SIZES, PATCH_SIZE

_RGB8_SNORM = 0x8F96


@dataclass(frozen=True)
class AtlasLayout:
    """Where an atom's texels lie: at level l of size s, atom k is cell k of rows of width // s, below `bands[l]`.

    Levels count from that of 32 texels, whether or not the dictionary has it.
    """

    width: int
    height: int
    bands: tuple[int, ...]  # the first row of each level, 0 of those that are not there

    def corner(self, atom: int, level: int) -> tuple[int, int]:
        """Column and row of the atom's first texel; splat_codes.glsl computes the same."""
        size = MIP_SIZES[level]
        row, column = divmod(atom, self.width // size)
        return column * size, self.bands[level] + row * size


def atlas_layout(n_atoms: int, atom_size: int = PATCH_SIZE, coarsest_size: int = 1) -> AtlasLayout:
    """The layout of a dictionary with the levels between two sizes; about as wide as its finest level is high."""
    width = atom_size * ceil(sqrt(n_atoms))
    heights = [-(-n_atoms // (width // size)) * size if coarsest_size <= size <= atom_size else 0 for size in MIP_SIZES]
    ends = np.cumsum(heights).tolist()
    return AtlasLayout(width, ends[-1], (0, *ends[:-1]))


def atlas_picture(levels: list[np.ndarray], layout: AtlasLayout) -> np.ndarray:
    """All levels' atoms, (k, s, s, 3) int8 each, the finest first, as one (height, width, 3) picture."""
    picture = np.zeros((layout.height, layout.width, 3), np.int8)
    first = MIP_SIZES.index(levels[0].shape[1])
    for atoms, size, top in zip(levels, MIP_SIZES[first:], layout.bands[first:]):
        columns = layout.width // size
        rows = -(-len(atoms) // columns)
        cells = np.zeros((rows * columns, size, size, 3), np.int8)
        cells[: len(atoms)] = atoms
        band = cells.reshape(rows, columns, size, size, 3).transpose(0, 2, 1, 3, 4)
        picture[top : top + rows * size] = band.reshape(rows * size, layout.width, 3)
    return picture


def upload_atlas(context: moderngl.Context, levels: list[np.ndarray]) -> tuple[moderngl.Texture, int]:
    """The texture of a dictionary, and its bytes."""
    n_atoms, finest = levels[0].shape[:2]
    layout = atlas_layout(n_atoms, finest, levels[-1].shape[1])
    limit = context.info["GL_MAX_TEXTURE_SIZE"]
    if max(layout.width, layout.height) > limit:
        raise ResourceExhausted(
            "dictionary texture",
            f"{len(levels[0])} atoms make it {layout.width}x{layout.height} texels",
            f"{limit} texels to a side",
        )
    picture = atlas_picture(levels, layout)
    size = layout.width, layout.height
    texture = context.texture(size, 3, picture.tobytes(), dtype="ni1", internal_format=_RGB8_SNORM)
    texture.filter = moderngl.LINEAR, moderngl.LINEAR
    texture.repeat_x = texture.repeat_y = False
    return texture, picture.nbytes
