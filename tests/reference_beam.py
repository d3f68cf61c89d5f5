"""A slow float64 twin of the pursuit with a beam, written to be read: no Gram matrix, no recursion, all atoms of every
support."""

from __future__ import annotations

import numpy as np

LEAST_OUTSIDE = 2e-3  # of an atom's squared norm that lies outside the span of the support, else it is passed over
HOPE = 0.4  # of what the best support's last atom mended of it with exact weights, what another's next is taken to mend


def beam(patch, dictionary, max_atoms, width, candidates, tolerance=0.0, multiplier=0.0, levels=None):
    """The best support of the last step by rank, its weights, and what the best of 0, 1, ... atoms leaves."""
    patch, dictionary = patch.astype(np.float64), dictionary.astype(np.float64)
    path, nodes, best = [float(patch @ patch)], [((), ())], None
    while len(path) <= max_atoms and path[-1] > tolerance:
        kept: list[tuple] = []  # what is left, support, ranks of its atoms, weights
        n_kept = width if len(path) < max_atoms else 1
        for support, ranks in nodes:
            n_tried = max(width, candidates) if not support else candidates
            for atom in by_what_they_leave(patch, dictionary, support)[:n_tried]:
                most = kept[-1][0] if len(kept) == n_kept else path[-1] - multiplier
                child = valued(patch, dictionary, (*support, atom), (*ranks, len(ranks)), levels)
                same = [other for other in kept if set(other[1]) == set(child[1])]
                if child[0] < most and not (same and same[0][0] <= child[0]):
                    kept = sorted([other for other in kept if other not in same] + [child], key=lambda c: c[0])[:n_kept]
        if not kept:
            break
        best = kept[0]
        before, now = (unrounded(patch, dictionary, support) for support in (nodes[0][0], best[1]))
        hoped = best[0] - multiplier + HOPE * (before - now)
        nodes = [best[1:3], *(c[1:3] for c in kept[1:] if unrounded(patch, dictionary, c[1]) < hoped)]
        path.append(best[0])
    if best is None:
        return [], np.empty(0), path
    order = np.argsort(best[2])
    return [best[1][i] for i in order], np.array(best[3])[order], path


def unrounded(patch, dictionary, support) -> float:
    """What a support leaves with exact weights."""
    atoms = dictionary[list(support)]
    return left(patch, atoms, fitted(patch, atoms))


def valued(patch, dictionary, support, ranks, levels):
    """What a support leaves, with itself, its ranks and its weights, at `levels` if there are any."""
    atoms = dictionary[list(support)]
    weight = fitted(patch, atoms)
    if levels is not None:
        weight = settled(patch, atoms, nearest(weight, levels[list(ranks)]), levels[list(ranks)])
        ranks, weight = exchanged(patch, atoms, weight, ranks, levels)
    return left(patch, atoms, weight), support, ranks, tuple(weight)


def exchanged(patch, atoms, weight, ranks, levels):
    """Each atom, the last first, with the rank of that of those before it with which this leaves least, if less."""
    for i in range(len(ranks) - 1, 0, -1):
        tried = [(left(patch, atoms, weight), ranks, weight)]
        for j in range(i):
            swapped, other = list(ranks), weight.copy()
            swapped[i], swapped[j] = ranks[j], ranks[i]
            for a in (i, j):
                other[a] = best_level(patch, atoms, other, a, levels[swapped[a]])
            tried.append((left(patch, atoms, other), tuple(swapped), other))
        least = min(tried, key=lambda found: found[0])
        if least is not tried[0]:
            ranks, weight = least[1], settled(patch, atoms, least[2], levels[list(least[1])])
    return ranks, weight


def by_what_they_leave(patch, dictionary, support) -> list[int]:
    """Atoms outside the support, the one first that leaves least once all weights are fitted again."""
    found = []
    for atom in set(range(len(dictionary))) - set(support):
        inside = dictionary[list(support)]
        outside = dictionary[atom] - fitted(dictionary[atom], inside) @ inside if support else dictionary[atom]
        if outside @ outside > LEAST_OUTSIDE:
            atoms = dictionary[[*support, atom]]
            found.append((left(patch, atoms, fitted(patch, atoms)), atom))
    return [atom for _, atom in sorted(found)]


def fitted(patch, atoms):
    return np.linalg.lstsq(atoms.T, patch, rcond=None)[0]


def left(patch, atoms, weight) -> float:
    return float(((patch - weight @ atoms) ** 2).sum())


def nearest(weight, levels):
    return np.array([row[np.abs(row - w).argmin()] for w, row in zip(weight, levels)])


def best_level(patch, atoms, weight, j, row):
    tried = [left(patch, atoms, np.where(np.arange(len(weight)) == j, level, weight)) for level in row]
    return row[int(np.argmin(tried))]


def settled(patch, atoms, weight, levels):
    """Twice each weight in turn at the level that leaves least, given the others."""
    weight = weight.copy()
    for _ in range(2):
        for j, row in enumerate(levels):
            weight[j] = best_level(patch, atoms, weight, j, row)
    return weight
