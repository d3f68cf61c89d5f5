"""Where the splats of a chunk lie on the plane of its first two axes: by how many of a cell's splats lie in its first
half, cell by cell, down to cells that are no longer cut. So it is told which cells are taken, never by which splat, and
log2(n!) bits of the order of n splats are not kept.

Reference: Devillers and Gandoin, "Geometric compression for interactive transmission", Visualization 2000.
"""

from __future__ import annotations

import numpy as np

from storage.packed.archive.coder import SIGNED, compiled, length_of, share, within
from storage.packed.archive.mixing import N_BASES, mixed_signed, mixed_tree
from storage.packed.schema import CHUNK

FEW = 8  # splats of a cell that have models of their own, by how crowded it is
DENSITIES, COUNT_BITS = 8, 4  # octaves of cells a splat against the chunk's, from an eighth on; bits of a count
COUNT_MODELS = (FEW + 1) * DENSITIES << COUNT_BITS
MANY_MODELS = 9 * SIGNED  # by how many bits the count has
_DEEPEST = 64  # of cells that wait: at most one for each cut, and no more than 50 cuts


@compiled
def code_cells(state, data, models, weights, base, cells, steps, order, fields):
    """Writes or reads the cells of `order` (n,), rows of `fields` whose columns 0 and 1 are cells along two axes with
    `cells` (2,) and sides `steps` (2,). A writer finds `order` put in the order in which a reader finds the cells."""
    n, few, many = len(order), base, base + COUNT_MODELS
    waiting = np.zeros((_DEEPEST, 5), np.int64)
    second, bases = np.zeros(CHUNK, np.int64), np.empty(N_BASES, np.int64)
    waiting[0, 0], waiting[0, 2], waiting[0, 4] = n, cells[0], cells[1]
    top, at = 1, 0
    while top:
        top -= 1
        cell = waiting[top]
        m, u, width, v, height = cell[0], cell[1], cell[2], cell[3], cell[4]
        if width * height == 1:
            for i in range(at, at + m):
                fields[order[i], 0], fields[order[i], 1] = u, v
            at += m
            continue
        along_u = width > 1 and (height == 1 or width * steps[0] >= height * steps[1])
        extent = width if along_u else height
        half, k = extent // 2, 0
        if state[5]:
            k = _cut(fields, order, at, m, 0 if along_u else 1, (u if along_u else v) + half, second)
        if m == 1:
            k = 1 - share(state, data, half, extent, 1 - k)
        elif m <= FEW:
            crowded = min(length_of(8 * width * height * n // (cells[0] * cells[1] * m)), DENSITIES - 1)
            bases[0] = few + ((m * DENSITIES + crowded) << COUNT_BITS)
            k = mixed_tree(state, data, models, weights, bases, 1, 0, COUNT_BITS, k)
        else:
            usual = (m * half + extent // 2) // extent
            bases[0] = many + length_of(m) * SIGNED
            k = usual + mixed_signed(state, data, models, weights, bases, 1, 0, k - usual)
        k = within(state, k, m + 1)
        for part in range(2):  # the first half is the next to be cut
            inside, begin, length = (k, 0, half) if part else (m - k, half, extent - half)
            if inside:
                cell = waiting[top]
                cell[0], cell[1], cell[2], cell[3], cell[4] = inside, u, width, v, height
                axis = 1 if along_u else 3
                cell[axis], cell[axis + 1] = cell[axis] + begin, length
                top += 1


@compiled
def _cut(fields, order, at, m, axis, cut, second):
    """Puts the m splats from `at` on that lie below the cut before the others, all else as it stood; how many do."""
    below, above = 0, 0
    for i in range(at, at + m):
        splat = order[i]
        if fields[splat, axis] < cut:
            order[at + below] = splat
            below += 1
        else:
            second[above] = splat
            above += 1
    for i in range(above):
        order[at + below + i] = second[i]
    return below
