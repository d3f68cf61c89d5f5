"""What the splats around a splat show where its own square lies, and which atoms go on with that.

Squares overlap: most of a splat's is covered by those of the splats around it that are told already. What they show
there, in grey and at 8x8 texels, is what its own texture most likely shows. Of every atom in every turn it is asked how
much of that it takes away, as a share of what the best takes away, `r`: the atom that a splat has is one of those with
a mass of 1 / (1.03 - r)^2, and its weight is near the one that takes most away. Sums are of whole numbers that float32
holds, so that no order of additions matters; all else is in the order that is written.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from storage.compile_once import compile_once
from storage.packed.archive.coder import compiled
from storage.packed.archive.mixing import STRETCH
from storage.packed.dictionaries.levels import levels_of
from storage.packed.schema import Header

# Loops in which no division is looked at, so that they take several numbers at once; nothing is reordered.
_compiled = lambda function: compile_once(numba.njit(cache=True, nogil=True, error_model="numpy")(function))

SIDE = 8  # texels
TEXELS, PARTS, FOLDED = SIDE * SIDE, 4, SIDE * SIDE // 4
TURNS, MOST_ATOMS = 8, 512  # of dictionaries that are looked at: how they turn, how many atoms they have at most
PEAK = 255.0  # of what a texel differs from the splat's average, in halves of a 255th
_REACH, _FARTHEST = np.float32(1.1), np.float32(2.0)  # of a neighbour's square along its axes; of x^2 + y^2
_OVER, _LITTLE = np.float32(1.03), 0.1
_ONE, _HALF, _QUARTER = np.float32(1.0), np.float32(0.5), np.float32(0.25)
_ACROSS = np.tile((np.arange(SIDE) + 0.5) * 2 / SIDE - 1, SIDE).astype(np.float32)
_DOWN = np.repeat((np.arange(SIDE) + 0.5) * 2 / SIDE - 1, SIDE).astype(np.float32)
_PLACE = np.arange(TEXELS).reshape(SIDE, SIDE)


def _turned(turn: int) -> np.ndarray:
    place = _PLACE[:, ::-1] if turn & 1 else _PLACE
    place = place[::-1] if turn & 2 else place
    return (place.T if turn & 4 else place).ravel()


TURNED = np.stack([_turned(turn) for turn in range(TURNS)])  # (8, 64): where a texel of a turned atom lies in the atom


@dataclass(frozen=True)
class Looks:
    """A file's atoms as they are looked at; none, where they are not."""

    luma: np.ndarray  # (k, 64) float32: whole means of the three channels of texels
    folded: np.ndarray  # (2, 4, 16, k) float32: those, then their squares, as parts that reversals keep or negate
    least: np.ndarray  # (k,) float32: what is added to four times the squares of the texels that are looked at
    worth: np.ndarray  # (k,) float64: halves of a 255th that 1 of luma is by a weight of 1
    levels: np.ndarray  # (r, w) float64: weights

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """What compiled loops take."""
        return self.luma, self.folded, self.least, self.worth, self.levels


def looks_of(header: Header, arrays: dict[str, np.ndarray]) -> Looks:
    """Of a file's dictionary, by the names of its arrays; of one that is not looked at with no atoms."""
    size = header.atom_size
    if not (header.n_turns == TURNS and 0 < header.n_dictionary <= MOST_ATOMS and size >= SIDE):
        none = np.zeros((0, TEXELS), np.float32)
        return Looks(none, np.zeros((2, PARTS, FOLDED, 0), np.float32), none[:, 0], np.zeros(0), np.zeros((1, 1)))
    texels = levels_of(arrays[f"atoms_{size}"], (SIDE,))[0].astype(np.int64)
    luma = np.floor_divide(2 * texels.sum(axis=3) + 3, 6)
    least = 4 * _LITTLE / 3 * (texels * texels).sum(axis=(1, 2, 3))
    folded = np.ascontiguousarray(np.stack([_folds(luma), _folds(luma * luma)]), np.float32)
    worth = 510 * _finite(arrays["atom_scale"])
    levels = _finite(arrays["weight_levels"])
    f = np.float32
    return Looks(luma.reshape(-1, TEXELS).astype(f), folded, (least + 1).astype(f), worth, levels)


def _finite(x: np.ndarray) -> np.ndarray:
    return np.nan_to_num(x.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0).clip(-1e6, 1e6)


def _folds(x: np.ndarray) -> np.ndarray:
    """Parts (4, 16, k) of (k, 8, 8): even along both axes, odd along columns, odd along rows, odd along both."""
    half, rows = SIDE // 2, (x + x[:, ::-1], x - x[:, ::-1])
    parts = [(r + r[..., ::-1], r - r[..., ::-1]) for r in rows]
    return np.stack([part[:, :half, :half].reshape(len(x), FOLDED).T for pair in parts for part in pair])


@_compiled
def continued(places, axes, radii, shown, splat, near, n, found, nearest, across, down):
    """What the n neighbours show at the texels of a splat's square, (64,), in `found`; how many texels they do, which
    are those whose `nearest` (64,) is less than _FARTHEST. Each shows what the neighbour does in whose square it lies
    nearest to the middle. `places` (n, 3), `axes` (n, 6) of squares in them and `radii` (n,); `shown` (n, 64)."""
    nearest[:] = _FARTHEST
    whose = np.zeros(TEXELS, np.int32)
    for k in range(n):
        other = near[k]
        u, v = places[splat, 0] - places[other, 0], places[splat, 1] - places[other, 1]
        w, by = places[splat, 2] - places[other, 2], 1 / radii[other]
        x0 = np.float32((u * axes[other, 0] + v * axes[other, 1] + w * axes[other, 2]) * by)
        y0 = np.float32((u * axes[other, 3] + v * axes[other, 4] + w * axes[other, 5]) * by)
        side = np.float32(radii[splat] * by)
        for i in range(TEXELS):
            x, y = x0 + _ACROSS[i] * side, y0 + _DOWN[i] * side
            far = x * x + y * y
            if far < nearest[i] and abs(x) < _REACH and abs(y) < _REACH:
                nearest[i], whose[i], across[i], down[i] = far, other, x, y
    covered = 0
    for i in range(TEXELS):
        if nearest[i] < _FARTHEST:
            covered += 1
            x, y = (across[i] + _ONE) * np.float32(4) - _HALF, (down[i] + _ONE) * np.float32(4) - _HALF
            column, row = np.int64(np.floor(x)), np.int64(np.floor(y))
            x, y = x - np.float32(column), y - np.float32(row)
            left, right = max(column, 0), min(column + 1, SIDE - 1)
            top, bottom = SIDE * max(row, 0), SIDE * min(row + 1, SIDE - 1)
            of = shown[whose[i]]
            above = of[top + left] + (of[top + right] - of[top + left]) * x
            below = of[bottom + left] + (of[bottom + right] - of[bottom + left]) * x
            found[i] = above + (below - above) * y
    return covered


@_compiled
def differing(found, nearest, light, differs, looked):
    """By how much what is shown differs from the splat's average, whole numbers in `differs` (64,), 0 where nothing is;
    `looked` (64,) is 1 where something is. Returns the sum of their squares."""
    squares = 0.0
    for i in range(TEXELS):
        looked[i] = differs[i] = 0
        if nearest[i] < _FARTHEST:
            looked[i] = 1
            differs[i] = np.floor(min(max(found[i] - light, -PEAK), PEAK) + 0.5)
            squares += np.float64(differs[i]) * np.float64(differs[i])
    return squares


@_compiled
def _fold(x, exchanged, parts):
    half = SIDE // 2
    for row in range(half):
        for column in range(half):
            a, b = SIDE * row + column, SIDE * row + SIDE - 1 - column
            c, d = SIDE * (SIDE - 1 - row) + column, SIDE * (SIDE - 1 - row) + SIDE - 1 - column
            if exchanged:
                a, d = SIDE * column + row, SIDE * (SIDE - 1 - column) + SIDE - 1 - row
                b, c = SIDE * (SIDE - 1 - column) + row, SIDE * column + SIDE - 1 - row
            at = half * row + column
            above, below, left, right = x[a] + x[b], x[c] + x[d], x[a] - x[b], x[c] - x[d]
            parts[0, at], parts[1, at] = above + below, left + right
            parts[2, at], parts[3, at] = above - below, left - right


@_compiled
def _products(parts, folded, sums, out):
    """Four times the products (4, k) in `out` of 64 numbers in `parts` with all atoms in the four turns of reversals."""
    k = folded.shape[2]
    for part in range(PARTS):
        row = sums[part]
        for a in range(k):
            row[a] = 0
        for i in range(0, FOLDED, 4):
            p, q, r, s = parts[part, i], parts[part, i + 1], parts[part, i + 2], parts[part, i + 3]
            at_p, at_q, at_r, at_s = folded[part, i], folded[part, i + 1], folded[part, i + 2], folded[part, i + 3]
            for a in range(k):
                row[a] += (p * at_p[a] + q * at_q[a]) + (r * at_r[a] + s * at_s[a])
    for a in range(k):
        even, odd = sums[0, a] + sums[2, a], sums[1, a] + sums[3, a]
        out[0, a], out[1, a] = even + odd, even - odd
        even, odd = sums[0, a] - sums[2, a], sums[1, a] - sums[3, a]
        out[2, a], out[3, a] = even + odd, even - odd


@_compiled
def measure(looked, folded, least, parts, sums, sizes):
    """Four times the squares of each atom in each turn where it is looked at, and its `least`, (8, k) in `sizes`."""
    for exchanged in range(2):
        _fold(looked, exchanged, parts)
        _products(parts, folded[1], sums, sizes[4 * exchanged : 4 * exchanged + 4])
    for turn in range(TURNS):
        for a in range(len(least)):
            sizes[turn, a] += least[a]


@_compiled
def look(differs, folded, parts, sums, products, sizes, masses, nodes):
    """How likely each atom is in each turn, (8, k) in `masses`, and the sums of that of a tree of atoms in `nodes`;
    whether there is anything to go by."""
    k = sizes.shape[1]
    for exchanged in range(2):
        _fold(differs, exchanged, parts)
        _products(parts, folded[0], sums, products[4 * exchanged : 4 * exchanged + 4])
    most, best = sums[0], np.float32(0)
    most[:] = 0
    for turn in range(TURNS):
        for a in range(k):
            share = products[turn, a] * products[turn, a] / sizes[turn, a]
            masses[turn, a] = share
            most[a] = share if share > most[a] else most[a]
    for a in range(k):
        best = most[a] if most[a] > best else best
    if best <= 0:
        return False
    by, first = _ONE / best, len(nodes) // 2
    nodes[:] = 0
    leaves = nodes[first : first + k]
    for turn in range(TURNS):
        for a in range(k):
            less = _OVER - masses[turn, a] * by
            mass = _ONE / (less * less)
            masses[turn, a] = mass
            leaves[a] += mass
    for node in range(first - 1, 0, -1):
        nodes[node] = nodes[2 * node] + nodes[2 * node + 1]
    return True


@compiled
def said_by(first, second):
    """How likely 0 is against 1 in the logistic domain, of two masses."""
    both = first + second
    if both <= 0:
        return np.int64(0)
    return np.int64(STRETCH[min(max(np.int64(np.float32(4096) * first / both), 1), 4095)])


@_compiled
def take_away(differs, looked, luma, turn, amount):
    """What an atom shows is taken from what is looked at; it is `amount` by 1 of luma."""
    at = TURNED[turn]
    for i in range(TEXELS):
        if looked[i]:
            differs[i] = np.floor(min(max(differs[i] - amount * luma[at[i]], -PEAK), PEAK) + 0.5)


@_compiled
def add(shown, luma, turn, amount):
    """What an atom shows is added to what its splat shows."""
    at = TURNED[turn]
    for i in range(TEXELS):
        shown[i] += np.float32(amount * luma[at[i]])


@compiled
def nearest_level(levels, wanted):
    """The code of the level that is nearest to a weight, of equal ones the first."""
    found = 0
    for code in range(1, len(levels)):
        if abs(levels[code] - wanted) < abs(levels[found] - wanted):
            found = code
    return found
