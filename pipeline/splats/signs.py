"""Which side of a surface is out, where nobody says: signs of estimated normals that agree from neighbour to neighbour.

Normals are passed on along the spanning tree of neighbourhoods in which they turn least, so that a sign crosses an edge
of the surface only where no gentler way leads; a part that touches no other begins at the point that lies farthest out
along its own normal, which looks away from the middle.

References: Hoppe et al., *Surface reconstruction from unorganized points*, SIGGRAPH 1992, section 3.3.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree

from pipeline.execution.compiled import kernel

NEIGHBOURS = 8
MOST_POINTS = 1 << 20  # that one process settles: 6 s and 1.1 GB; of more each looks away from the middle by itself
LEAST_WEIGHT = 1e-6  # of an edge between equal normals: a sparse graph has no edges of weight 0


def settled_signs(point: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Signs (n,) int8, 1 or -1, for unit `normal` (n, 3) at `point` (n, 3).

    Guarantees: the same for the same points in the same order; of two opposite normals at one point one is turned.
    """
    n = len(point)
    if n < 2:
        return np.ones(n, np.int8)
    near = cKDTree(point).query(point, min(NEIGHBOURS + 1, n))[1]
    from_, to = np.repeat(np.arange(n), near.shape[1]), near.ravel()
    edge = from_ != to
    from_, to = from_[edge], to[edge]
    weight = 1 - np.abs(np.einsum("ij,ij->i", normal[from_], normal[to])).clip(0, 1) + LEAST_WEIGHT
    graph = csr_matrix((weight, (from_, to)), (n, n))
    root, sign = _beginnings(graph, point, normal)
    tree = minimum_spanning_tree(graph).tocoo()
    # A node before all parts, from which one walk reaches each of them.
    all_from, all_to = np.append(tree.row, np.full(len(root), n)), np.append(tree.col, root)
    walk = csr_matrix((np.ones(len(all_from)), (all_from, all_to)), (n + 1, n + 1))
    order, before = breadth_first_order(walk, n, directed=False)
    signs = np.zeros(n + 1, np.int8)
    signs[root] = sign
    _passed_on(signs, order[1:], before, normal)
    return signs[:n]


def _beginnings(graph: csr_matrix, point: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each part of the graph the point that lies farthest out along its normal, and the sign by which it looks
    out."""
    n_parts, part = connected_components(graph, directed=False)
    middle = (point.min(axis=0) + point.max(axis=0)) / 2
    out = np.einsum("ij,ij->i", normal, point - middle)
    order = np.lexsort((np.arange(len(point)), -np.abs(out), part))
    root = order[np.searchsorted(part[order], np.arange(n_parts))]
    return root, np.where(out[root] < 0, -1, 1).astype(np.int8)


@kernel()
def _passed_on(signs, order, before, normal):
    """Fill `signs`, of which only those of the beginnings are not 0, in the order of a walk."""
    for k in range(len(order)):
        i = order[k]
        if signs[i] == 0:
            j = before[i]
            dot = normal[i, 0] * normal[j, 0] + normal[i, 1] * normal[j, 1] + normal[i, 2] * normal[j, 2]
            signs[i] = -signs[j] if dot < 0 else signs[j]
