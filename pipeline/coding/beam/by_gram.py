"""Order-recursive pursuit with a beam, by a Gram matrix: a kernel a patch, as `omp_kernels.pursue`."""

from __future__ import annotations

import numpy as np

from pipeline.coding.beam.nodes import Nodes, Pool, Products, make_nodes, new_pool, store_best, try_children
from pipeline.coding.beam.passes import borrowed_tables, explained, new_tables, score_beside
from pipeline.coding.beam.scores import Scores, Tiles, of_node, score_first
from pipeline.coding.beam.weights import Levels, prepare_levels, searched_levels
from pipeline.coding.omp_kernels import TRUSTED, n_groups
from pipeline.execution.compiled import borrowed, kernel, part


def new_nodes(width: int, most: int) -> Nodes:
    """Room for `width` nodes of at most `most` atoms."""
    ranks, square = (width, most), (width, most, most)
    return Nodes(
        np.empty(ranks, np.int64), np.empty(ranks), np.empty(ranks), np.empty(square), np.empty(square), np.empty(ranks, np.int64),
        np.empty(ranks, np.int64), np.empty(ranks, np.int32), np.empty(width), np.zeros(width, np.uint64),
    )  # fmt: skip


@part()
def _borrowed_nodes(n):
    return Nodes(
        borrowed(n.support), borrowed(n.target), borrowed(n.along), borrowed(n.gram), borrowed(n.chol), borrowed(n.slot),
        borrowed(n.rank), borrowed(n.code), borrowed(n.exact), borrowed(n.key),
    )  # fmt: skip


@part()
def _borrowed_pool(p):
    return Pool(
        borrowed(p.order), borrowed(p.parent), borrowed(p.atom), borrowed(p.key), borrowed(p.target), borrowed(p.along), borrowed(p.exact),
        borrowed(p.error), borrowed(p.gram), borrowed(p.chol), borrowed(p.weight), borrowed(p.rank), borrowed(p.code), borrowed(p.left),
        borrowed(p.tried),
    )  # fmt: skip


def pursue_beam(
    patches, dictionary, initial, spread, rest, certify, energy, gram, quotients, tolerance, multiplier, levels, width, candidates,
    atom, weight, code, n_atoms, path,
):  # fmt: skip
    """As `omp_kernels.pursue`, by order-recursive selection with a beam; `initial` is overwritten.

    Of each of up to `width` supports the `candidates` atoms of highest score (of the empty one `width`, if those are
    more) are tried. Of all supports so made that lower the residual by more than `multiplier`, the `width` that leave
    least are kept. path (n, r + 1): what the best of t atoms leaves, t = 0, 1, and so on; the codes are the best of the
    last step.
    """
    k, most = initial.shape[1], atom.shape[1]
    tile = 2 * n_groups(k)
    tiles = Tiles.of(len(gram), len(quotients), tile)
    upper = np.empty((width, tile), np.float32)
    scratch = (np.zeros(k, np.float32), np.empty((width, k), np.float32), upper)
    _pursue(
        patches, dictionary, initial, spread, rest, certify, energy, gram, quotients, tolerance, multiplier, searched_levels(levels), width, candidates,
        atom, weight, code, n_atoms, path, new_nodes(width, most), new_nodes(width, most), new_pool(width, candidates, most), scratch, upper.view(np.int32),
        tiles, new_tables(gram, quotients, width, most, tile),
    )  # fmt: skip


@kernel()
def _pursue(
    patches, dictionary, initial, spread, rest, certify, energy, gram, quotients, tolerance, multiplier, levels, width, candidates,
    atom, weight, code, n_atoms, path, nodes_now, nodes_next, made_pool, scratch, bits, all_tiles, all_tables,
):  # fmt: skip
    n, k = initial.shape
    most = atom.shape[1]
    patches, dictionary, initial, gram, quotients, levels = (
        borrowed(patches), borrowed(dictionary), borrowed(initial), borrowed(gram), borrowed(quotients), Levels(borrowed(levels.value), borrowed(levels.first), borrowed(levels.cells)),
    )  # fmt: skip
    atom, weight, code, path, rest = borrowed(atom), borrowed(weight), borrowed(code), borrowed(path), borrowed(rest)
    slack, score, upper = borrowed(scratch[0]), borrowed(scratch[1]), borrowed(scratch[2])
    tables, tiles = borrowed_tables(all_tables), Tiles(borrowed(all_tiles.start), borrowed(all_tiles.length))
    nodes, children, pool = _borrowed_nodes(nodes_now), _borrowed_nodes(nodes_next), _borrowed_pool(made_pool)
    prepare_levels(levels)
    products = Products(dictionary, gram, quotients)
    for i in range(n):
        unit = 1.0 / np.sqrt(energy[i])
        for a in range(k):
            initial[i, a] = np.float32(unit * initial[i, a])
        if spread[i] > 0:  # else slack is zero
            trust = np.float32(unit * spread[i]) * (np.float32(1) if certify else TRUSTED)
            for a in range(k):
                slack[a] = trust * rest[a]
        s = Scores(initial[i], slack, np.uintp(spread[i] > 0), score, upper, borrowed(bits), tiles)
        t, n_nodes = 0, 1
        path[i, 0] = nodes.exact[0] = energy[i]
        nodes.key[0] = 0
        while t < most and path[i, t] > max(tolerance[i], multiplier):
            n_kept, last, n_wanted = 0, max(0, t - 1), width if t + 1 < most else 1
            if t == 0:
                score_first(of_node(s, 0))
            else:
                score_beside(s, tables, nodes, n_nodes, unit, last)
            for b in range(n_nodes):
                n_kept = try_children(
                    nodes, b, t, of_node(s, b), (tables, b, last), explained, candidates if t else max(candidates, width),
                    path[i, t] - multiplier, patches[i], energy[i], unit, products, levels, pool, n_kept, n_wanted,
                )  # fmt: skip
            if n_kept == 0:
                break
            store_best(nodes, t, pool, atom[i], weight[i], code[i])
            n_nodes = make_nodes(nodes, t, pool, n_kept, multiplier, children)
            t += 1
            path[i, t] = pool.error[pool.order[0]]
            nodes, children = children, nodes
        n_atoms[i] = t
