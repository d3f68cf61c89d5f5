"""Which atoms a splat has and with which weights: the atoms by themselves and by rank and by what the splats around it
show, the weights by rank, by those before, by how many atoms there are, by the atom, and by what it would take away.
"""

from __future__ import annotations

import numpy as np

from storage.packed.archive.coder import compiled
from storage.packed.archive.continued import (
    FOLDED,
    PARTS,
    TEXELS,
    TURNS,
    add,
    look,
    measure,
    nearest_level,
    said_by,
    take_away,
)
from storage.packed.archive.mixing import TREE_SETS, mixed, mixed_tree

_INDEX_BITS = 9  # of an atom's index that its weight is told by
ATOM_MODELS = 9  # of each atom
_BEFORE, _COUNTS, _EARLIER, _BY_ATOM, _BY_LOOK = 16 * 16, 16 * 16 * 17, 2 * 16 * 16, 1 << _INDEX_BITS, 1 + 4 * 4 * 16
WEIGHT_MODELS = _BEFORE + _COUNTS + _EARLIER + _BY_ATOM + _BY_LOOK  # of each level
N_SUPPORT_SETS = 6 * TREE_SETS  # of atoms, of turns, of weights by the rank


@compiled
def room_of(k, atom_bits):
    """What is worked in: how a splat's texels differ from its average and which are looked at, folded parts, sums,
    products, sizes and masses of k atoms, and a tree of them."""
    f = np.float32
    return (
        np.zeros(TEXELS, f), np.zeros(TEXELS, f), np.zeros((PARTS, FOLDED), f), np.zeros((PARTS, k), f),
        np.zeros((TURNS, k), f), np.zeros((TURNS, k), f), np.zeros((TURNS, k), f), np.zeros(2 << atom_bits, f),
    )  # fmt: skip


@compiled
def code_atoms(
    state, data, models, weights, at, which, bits, turn_bits, atom_bits, looks, room, covered, light, shown, entries,
    first, n_atoms, bases,
):  # fmt: skip
    """Writes or reads `n_atoms` rows of `entries` from `first` on; `shown` (1, 64) becomes what the splat shows, where
    anything is looked at. Models of atoms and of weights begin at `at` (2,), sets of weights at `which`."""
    luma, folded, least, worth, levels = looks
    differs, looked, parts, sums, products, sizes, masses, nodes = room
    base, turns, before, earlier = at[1], at[0] + (ATOM_MODELS << atom_bits), 0, 0
    short, low = max(0, atom_bits - _INDEX_BITS), max(0, bits - 4)
    sees, quarter = len(luma) > 0, max(4 * covered - 1, 0) // TEXELS
    if sees:
        shown[0, :] = light
    if n_atoms and covered:
        measure(looked, folded, least, parts, sums, sizes)
    for rank in range(n_atoms):
        entry = entries[first + rank]
        knows = covered > 0 and look(differs, folded, parts, sums, products, sizes, masses, nodes)
        atom = _code_atom(
            state, data, models, weights, at[0], which, atom_bits, rank, knows, nodes, entry, turn_bits, bases
        )
        inside = atom < len(luma)
        bases[0] = turns
        bases[1] = turns + (1 + atom << turn_bits)
        turn = _code_turn(
            state, data, models, weights, which + TREE_SETS, turn_bits, knows and inside, masses, atom, entry, bases
        )
        entry[0] = atom << turn_bits | turn
        place, met = 16 * rank + before, 0
        if knows and inside and worth[atom] > 0:
            wanted = np.float64(products[turn, atom]) / np.float64(sizes[turn, atom]) / worth[atom]
            met = 1 + (min(rank, 3) * 4 + quarter) * 16 + (nearest_level(levels[rank], wanted) >> low)
        bases[0] = base + (place << bits)
        bases[1] = base + ((_BEFORE + place * 17 + n_atoms) << bits)
        bases[2] = base + ((_BEFORE + _COUNTS + 2 * (16 * earlier + before) + (1 if rank == 0 else 0)) << bits)
        bases[3] = base + ((_BEFORE + _COUNTS + _EARLIER + (atom >> short)) << bits)
        bases[4] = base + ((_BEFORE + _COUNTS + _EARLIER + _BY_ATOM + met) << bits)
        set_ = which + TREE_SETS * (2 + min(rank, 3))
        entry[1] = mixed_tree(state, data, models, weights, bases, 5, set_, bits, entry[1])
        earlier, before = before, entry[1] >> low
        if sees and inside:
            amount = worth[atom] * levels[rank, entry[1]]
            add(shown[0], luma[atom], turn, amount)
            take_away(differs, looked, luma[atom], turn, amount)


@compiled
def _code_atom(state, data, models, weights, base, which, bits, rank, knows, nodes, entry, turn_bits, bases):
    bases[0] = base
    bases[1] = base + (1 + min(rank, 7) << bits)
    node = 1
    for k in range(bits - 1, -1, -1):
        said = said_by(nodes[2 * node], nodes[2 * node + 1]) if knows else 0
        bit = (entry[0] >> (turn_bits + k)) & 1
        set_ = which + min(node, TREE_SETS - 1)
        node = 2 * node + mixed(state, data, models, weights, bases, 2, node, set_, bit, said)
    return node - (1 << bits)


@compiled
def _code_turn(state, data, models, weights, which, bits, knows, masses, atom, entry, bases):
    node = 1
    for k in range(bits - 1, -1, -1):
        said = 0
        if knows:
            first, second, begin = np.float32(0), np.float32(0), (2 * node << k) - (1 << bits)
            for turn in range(begin, begin + (1 << k)):
                first += masses[turn, atom]
                second += masses[turn + (1 << k), atom]
            said = said_by(first, second)
        set_ = which + min(node, TREE_SETS - 1)
        node = 2 * node + mixed(state, data, models, weights, bases, 2, node, set_, (entry[0] >> k) & 1, said)
    return node - (1 << bits)
