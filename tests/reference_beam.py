"""A slow float64 twin of the pursuit with a beam, written to be read: no Gram matrix, no recursion, all atoms of every
support."""

from __future__ import annotations

import numpy as np

LEAST_OUTSIDE = 2e-3  # of an atom's squared norm that lies outside the span of the support, else it is passed over


def beam(patch, dictionary, max_atoms, width, candidates, tolerance=0.0, multiplier=0.0, levels=None):
    """The best support of the last step, its weights, and what the best of 0, 1, ... atoms leaves."""
    patch, dictionary = patch.astype(np.float64), dictionary.astype(np.float64)
    path, nodes, best = [float(patch @ patch)], [()], ((), np.empty(0))
    while len(path) <= max_atoms and path[-1] > tolerance:
        children = []
        for support in nodes:
            n_tried = max(width, candidates) if not support else candidates
            for atom in by_what_they_leave(patch, dictionary, support)[:n_tried]:
                child = (*support, atom)
                weight = fitted(patch, dictionary[list(child)])
                if levels is not None:
                    weight = settled(patch, dictionary[list(child)], weight, levels)
                children.append((left(patch, dictionary[list(child)], weight), child, weight))
        kept: dict[frozenset, tuple] = {}
        for child in sorted(children, key=lambda child: child[0]):
            if child[0] < path[-1] - multiplier and len(kept) < width:
                kept.setdefault(frozenset(child[1]), child)
        if not kept:
            break
        nodes = [support for _, support, _ in kept.values()]
        error, *best = next(iter(kept.values()))
        path.append(error)
    return list(best[0]), best[1], path


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


def settled(patch, atoms, weight, levels):
    """Each weight at the nearest level of its rank; then twice each in turn at the level that leaves least, given the
    others."""
    weight = np.array([row[np.abs(row - w).argmin()] for w, row in zip(weight, levels)])
    for _ in range(2):
        for j, row in enumerate(levels[: len(weight)]):
            tried = [left(patch, atoms, np.where(np.arange(len(weight)) == j, level, weight)) for level in row]
            weight[j] = row[int(np.argmin(tried))]
    return weight
