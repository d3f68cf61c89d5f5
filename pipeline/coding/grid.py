"""Patches as coefficients of what atoms of s x s texels can show on them, and atoms in the eight symmetries of the
square (D4).

An atom of fewer texels than a patch is shown by bilinear interpolation, as a GPU magnifies it. What s x s texels show
along one axis is spanned by s orthonormal columns, here taken in the order of their frequency: the cosines of the DCT
interpolated, then made orthonormal. They are even and odd alternately, so a mirrored atom has the signs of its odd
coefficients changed, and one mirrored at the diagonal its axes exchanged. Products, norms and least squares of
coefficients are those of the shown texels; what a patch has beyond them, no atom of this size can show.

Where a splat covers 7 photo pixels, 8 x 8 texels show 51 dB of `fountain_p11` and 41 dB of `monstree`, 16 x 16 texels
58 dB and 51 dB; a quarter of the texels is a quarter of the dictionary's bytes and of the time of learning and coding.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from storage.packed.schema import PATCH_SIZE

SYMMETRIES = 8  # bit 2: mirrored at the diagonal, before that bit 0: left to right, bit 1: top to bottom


@dataclass(frozen=True)
class AtomForm:
    """How many texels to a side atoms have, and in how many symmetries (1 or SYMMETRIES) a splat may take them."""

    size: int = PATCH_SIZE
    n_turns: int = 1

    def in_turns(self, atoms: np.ndarray) -> np.ndarray:
        """What indices name, (n_turns k, d), of atoms (k, d) as coefficients."""
        return in_all_symmetries(atoms, self.size) if self.n_turns > 1 else atoms

    def summed_back(self, rows: np.ndarray) -> np.ndarray:
        return summed_back(rows, self.size) if self.n_turns > 1 else rows


def coefficients(patches: np.ndarray, size: int) -> np.ndarray:
    """Coefficients (n, 3 size^2) float32, (row, column, rgb) by frequency, of patches (n, PATCH_DIM)."""
    return _along_both(patches, axis_columns(size).T)


def patches_of(coefficients: np.ndarray, size: int) -> np.ndarray:
    """What atoms, given by their coefficients (k, 3 size^2), are on a patch, (k, PATCH_DIM) float32: as `shown` of
    their texels."""
    return _along_both(coefficients, axis_columns(size))


def axis_columns(size: int) -> np.ndarray:
    """Orthonormal columns (PATCH_SIZE, size) float64 of what `size` texels show along an axis, by frequency."""
    return _axis(size)[0]


def coefficients_of_texels(texels: np.ndarray, size: int) -> np.ndarray:
    """Coefficients (k, 3 size^2) float32 of atoms, given by their texels (k, 3 size^2)."""
    _, of_texels = _axis(size)
    return _along_both(texels, of_texels)


def texels_of(coefficients: np.ndarray, size: int) -> np.ndarray:
    """Texels (k, 3 size^2) float32 of atoms, given by their coefficients: the inverse of `coefficients_of_texels`."""
    _, of_texels = _axis(size)
    return _along_both(coefficients, np.linalg.inv(of_texels))


def shown(texels: np.ndarray, size: int) -> np.ndarray:
    """What atoms of texels (k, 3 size^2) are on a patch, (k, PATCH_DIM) float32: interpolated, edges repeated."""
    return np.array(texels, np.float32) if size == PATCH_SIZE else _along_both(texels, _interpolation(size))


def in_all_symmetries(atoms: np.ndarray, size: int) -> np.ndarray:
    """Atoms (k, 3 size^2), coefficients, in all symmetries: (8 k, 3 size^2), symmetry t of atom a in row 8 a + t."""
    turned = np.stack([_turned(atoms.reshape(-1, size, size, 3), turn) for turn in range(SYMMETRIES)], axis=1)
    return turned.reshape(SYMMETRIES * len(atoms), -1)


def summed_back(rows: np.ndarray, size: int) -> np.ndarray:
    """The transpose of `in_all_symmetries`: rows (8 k, 3 size^2), each in the inverse of its symmetry and added up, (k,
    3 size^2)."""
    by_turn = rows.reshape(-1, SYMMETRIES, size, size, 3)
    total = sum(_turned_back(by_turn[:, turn], turn) for turn in range(SYMMETRIES))
    return total.reshape(len(by_turn), -1)  # type: ignore[union-attr]


def transformed_texels(texels: np.ndarray, turn: int) -> np.ndarray:
    """Texels (..., s, s, 3) of atoms in one symmetry."""
    turned = texels[..., ::-1, :] if turn & 1 else texels
    turned = turned[..., ::-1, :, :] if turn & 2 else turned
    return np.swapaxes(turned, -3, -2) if turn & 4 else turned


def _turned(atoms: np.ndarray, turn: int) -> np.ndarray:
    signed = atoms * _signs(atoms.shape[1], turn).astype(atoms.dtype)
    return np.swapaxes(signed, 1, 2) if turn & 4 else signed


def _turned_back(atoms: np.ndarray, turn: int) -> np.ndarray:
    straight = np.swapaxes(atoms, 1, 2) if turn & 4 else atoms
    return straight * _signs(atoms.shape[1], turn).astype(atoms.dtype)


def _signs(size: int, turn: int) -> np.ndarray:
    """(size, size, 1): -1 where a frequency is odd along an axis that is mirrored."""
    odd = np.where(np.arange(size) % 2, -1, 1)
    along_columns, along_rows = odd if turn & 1 else odd**2, odd if turn & 2 else odd**2
    return (along_rows[:, None] * along_columns)[:, :, None]


def _along_both(rows: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """`matrix` (m, s) applied along both axes of rows (n, 3 s^2): (n, 3 m^2) float32."""
    n, (m, s) = len(rows), matrix.shape
    matrix = matrix.astype(np.float32)
    along_rows = np.kron(matrix.T, np.eye(3, dtype=np.float32))  # (s 3, m 3): thrice the products, and no array turned
    rows = rows.astype(np.float32, copy=False)
    if m < s:  # the fewer rows the thrice as many products are made of, the better
        half = matrix @ rows.reshape(n, s, 3 * s)  # (n, m, s 3)
        return (half.reshape(n * m, 3 * s) @ along_rows).reshape(n, 3 * m * m)
    half = (rows.reshape(n * s, 3 * s) @ along_rows).reshape(n, s, 3 * m)
    return (matrix @ half).reshape(n, 3 * m * m)


@cache
def _interpolation(size: int) -> np.ndarray:
    """(PATCH_SIZE, size): each row the weights of a patch's texel in an atom's, by bilinear lookup with edges
    repeated."""
    if size == PATCH_SIZE:
        return np.eye(PATCH_SIZE)
    at = np.clip((np.arange(PATCH_SIZE) + 0.5) * size / PATCH_SIZE - 0.5, 0, size - 1)
    return np.maximum(0, 1 - np.abs(at[:, None] - np.arange(size)))


@cache
def _axis(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Orthonormal columns (PATCH_SIZE, size) of what `size` texels show, and (size, size): their coefficients by
    texel."""
    frequency, texel = np.arange(size), np.arange(size) + 0.5
    cosines = np.cos(np.pi / size * frequency * texel[:, None])
    shown = _interpolation(size) @ cosines
    columns = np.zeros_like(shown)
    for parity in (0, 1):  # even and odd ones are orthogonal whatever their numbers; apart, they stay so exactly
        columns[:, parity::2] = np.linalg.qr(shown[:, parity::2])[0]
        half = columns[: PATCH_SIZE // 2, parity::2]
        columns[PATCH_SIZE // 2 :, parity::2] = half[::-1] * (-1 if parity else 1)
    columns *= np.where((columns * shown).sum(axis=0) < 0, -1, 1)
    return columns, columns.T @ _interpolation(size)
