"""The dictionary as a picture: a grid of atoms, grey for zero, as Figure 8 of the HPG 2021 paper."""

from __future__ import annotations

import numpy as np

from storage.packed.packed import PackedScene
from storage.packed.schema import GROUP

MAX_SHOWN = 256
GAP_PX = 2
GREY, WHITE = 128, 255
_SPLATS_A_PIECE = 16 * GROUP


def atom_uses(scene: PackedScene) -> np.ndarray:
    """How many splats use each atom, (n_dictionary,) int64."""
    uses = np.zeros(scene.header.n_dictionary, np.int64)
    for start in range(0, scene.header.n_splats, _SPLATS_A_PIECE):
        stop = start + _SPLATS_A_PIECE
        atom, _ = scene.codes(start, stop)
        used = np.arange(atom.shape[1]) < scene.n_atoms[start:stop, None]
        uses += np.bincount(atom[used] // scene.header.n_turns, minlength=len(uses))
    return uses


def dictionary_picture(scene: PackedScene, max_shown: int = MAX_SHOWN) -> np.ndarray | None:
    """The most used atoms row by row, the most used first, (height, width, 3) uint8; None without a dictionary.

    The texels are stored so that the largest of each atom is +-127: each atom is shown with its full contrast.
    """
    if not scene.header.n_dictionary:
        return None
    size = scene.header.atom_size
    order = np.argsort(-atom_uses(scene), kind="stable")[:max_shown]
    texels = scene.arrays[f"atoms_{size}"][order].astype(np.int16)
    columns = int(np.ceil(np.sqrt(len(order))))
    rows = -(-len(order) // columns)
    cell = size + GAP_PX
    picture = np.full((rows * cell + GAP_PX, columns * cell + GAP_PX, 3), WHITE, np.uint8)
    for i, atom in enumerate(texels):
        top, left = GAP_PX + i // columns * cell, GAP_PX + i % columns * cell
        picture[top : top + size, left : left + size] = GREY + atom
    return picture
