"""What the splats of a group are, one after the other, each by the three nearest of its chunk that are known already.

Heights, steps of normals and colours are told by how far they are from the mean of those three, the nearest counted
twice, with models by how far the three are apart. Heights of boxes are not meant themselves but where the planes through
the neighbours, tilted as their normals and the splat's own, pass below the splat. Batches, sizes, cameras and stations
are told by those of the neighbours.
"""

from __future__ import annotations

import numpy as np

from storage.packed.archive.coder import SIGNED, bit, compiled, even, length_of, signed, tree, within
from storage.packed.archive.tree import COUNT_MODELS, MANY_MODELS, code_cells, nearest

# Columns of a splat.
U, V, HEIGHT, A, B, BATCH, SIZE, RED, GREEN, BLUE, CAMERA, STATION, LINE, ELLIPSOID = range(14)
N_FIELDS = 14

# What holds for all splats of a file, (N_FORMS,) int64.
N_BATCHES, SIZE_BITS, N_COLORS, IS_BYTES, N_CAMERAS, N_STATIONS, INDEX_BITS, WEIGHT_BITS, IS_BOXES = range(9)
N_FORMS = 9

# Of a chunk, (c, N_CHUNK) int64: splats, cells along its axes, steps of its normals, cells of its colours, and of boxes
# which axes are the first, the second and the height.
COUNT, CELLS, N_A, N_B, COLORS, AXES = 0, 1, 4, 5, 6, 9
N_CHUNK = 12

SPREADS = 12  # how far apart neighbours are, in octaves
NEAR = 4  # sizes, in octaves, of what was off in the field before
TREE_BITS = 8  # bits of a camera or a station that have models; those above are even
NOWHERE = 63  # a size that no neighbours have


def models_of(form: np.ndarray) -> np.ndarray:
    """Where the models of each field begin, (12,) int64; the last is how many there are."""
    batch_bits = length_of(int(form[N_BATCHES]) - 1)
    levels = 1 << int(form[WEIGHT_BITS])
    counts = [
        COUNT_MODELS + MANY_MODELS,
        (int(form[N_BATCHES]) + 1) * 2 << batch_bits,
        64 << 4,
        (SPREADS + 1) * SIGNED,
        (SPREADS + 1) * NEAR * SIGNED,
        (SPREADS + 4) * SIGNED,
        3 * (SPREADS + 1) * NEAR * SIGNED,
        2 * (4 + (1 << TREE_BITS)),
        3 * 16 * 16,
        4 << 8,
        1 << int(form[INDEX_BITS]),
        16 * 16 * levels,
    ]
    return np.concatenate([[0], np.cumsum(counts)])


@compiled
def code_splats(state, data, models, at, form, chunks, steps, kinds, fields, first, entries, order):
    """Writes or reads all splats of a group: `fields` (n, N_FIELDS), and of each its atoms and weights, rows of
    `entries` (m, 2) from `first` (n,) on. `order` (n,) becomes that in which they are told."""
    n_entries, begin = 0, 0
    near = np.zeros(3, np.int64)
    for c in range(len(chunks)):
        chunk, step = chunks[c], steps[c]
        rows = order[begin : begin + chunk[COUNT]]
        code_cells(state, data, models, at[0], chunk[CELLS : CELLS + 2], step, rows, fields)
        for i in range(len(rows)):
            splat, known = rows[i], nearest(fields, rows, i, step, near)
            _code_kind(state, data, models, at, form, splat, known, near, fields)
            _code_normal(state, data, models, at, chunk, splat, known, near, fields)
            _code_height(state, data, models, at, form, chunk, step, splat, known, near, fields)
            _code_color(state, data, models, at, form, chunk, splat, known, near, fields)
            for name in range(2):
                if form[N_CAMERAS + name]:
                    _code_source(state, data, models, at[7], name, form[N_CAMERAS + name], splat, known, near, fields)
            kind = kinds[fields[splat, BATCH]]
            if kind[1]:
                _code_line(state, data, models, at[8], splat, fields)
            if kind[2]:
                word = fields[splat, ELLIPSOID]
                fields[splat, ELLIPSOID] = 0
                for f in range(4):
                    found = tree(state, data, models, at[9] + (f << 8), 8, (word >> 8 * f) & 255)
                    fields[splat, ELLIPSOID] |= found << 8 * f
            if not state[5]:
                first[splat] = n_entries
            _code_atoms(state, data, models, at, form, entries, first[splat], kind[0])
            n_entries += kind[0]
        begin += chunk[COUNT]


@compiled
def _code_kind(state, data, models, at, form, splat, known, near, fields):
    """Batch and size."""
    if form[N_BATCHES] > 1:
        bits = length_of(form[N_BATCHES] - 1)
        usual, sure = form[N_BATCHES], 0
        if known:
            usual, sure = fields[near[0], BATCH], 1 if fields[near[0], BATCH] == fields[near[1], BATCH] else 0
        found = tree(state, data, models, at[1] + ((2 * usual + sure) << bits), bits, fields[splat, BATCH])
        fields[splat, BATCH] = within(state, found, form[N_BATCHES])
    if form[SIZE_BITS]:
        usual = 2 * fields[near[0], SIZE] + fields[near[1], SIZE] + fields[near[2], SIZE] if known else NOWHERE
        fields[splat, SIZE] = tree(state, data, models, at[2] + (usual << 4), form[SIZE_BITS], fields[splat, SIZE])


@compiled
def _usual(fields, near, column):
    """Mean of the neighbours, the nearest counted twice, and how far they are apart as octaves, 1..SPREADS."""
    x, y, z = fields[near[0], column], fields[near[1], column], fields[near[2], column]
    return (2 * x + y + z + 2) >> 2, 1 + min(length_of(max(x, y, z) - min(x, y, z)), SPREADS - 1)


@compiled
def _code_normal(state, data, models, at, chunk, splat, known, near, fields):
    off = 0
    for f in range(2):
        n = chunk[N_A + f]
        usual, spread = n >> 1, 0
        if known:
            usual, spread = _usual(fields, near, A + f)
        base = (
            at[3] + spread * SIGNED if f == 0 else at[4] + (spread * NEAR + min(length_of(abs(off)), NEAR - 1)) * SIGNED
        )
        off = signed(state, data, models, base, fields[splat, A + f] - usual)
        fields[splat, A + f] = within(state, usual + off, n)


@compiled
def _octahedral(a, b):
    c = 127 - abs(a) - abs(b)
    if c >= 0:
        return a, b, c
    return (127 - abs(b)) * (1 if a >= 0 else -1), (127 - abs(a)) * (1 if b >= 0 else -1), c


@compiled
def _code_height(state, data, models, at, form, chunk, step, splat, known, near, fields):
    n = chunk[CELLS + 2]
    usual, spread = n >> 1, 0
    if known and form[IS_BOXES]:
        own = _octahedral(fields[splat, A] - 127, fields[splat, B] - 127)
        total, low, high = 0.0, np.inf, -np.inf
        for k in range(3):
            other = near[k]
            at_other = _octahedral(fields[other, A] - 127, fields[other, B] - 127)
            normal = (own[0] + at_other[0], own[1] + at_other[1], own[2] + at_other[2])
            rise = (fields[splat, U] - fields[other, U]) * step[0] * normal[chunk[AXES]]
            rise += (fields[splat, V] - fields[other, V]) * step[1] * normal[chunk[AXES + 1]]
            across, height = step[2] * normal[chunk[AXES + 2]], np.float64(fields[other, HEIGHT])
            if abs(rise) < n * abs(across):  # so no division by 0, and nothing beyond the box
                height = min(max(height - rise / across, 0.0), n - 1.0)
            low, high = min(low, height), max(high, height)
            total += 2 * height if k == 0 else height
        usual = np.int64(np.floor(total / 4 + 0.5))
        spread = 1 + min(length_of(np.int64(high - low)), SPREADS + 2)
    elif known:
        usual, spread = _usual(fields, near, HEIGHT)
    off = signed(state, data, models, at[5] + spread * SIGNED, fields[splat, HEIGHT] - usual)
    fields[splat, HEIGHT] = within(state, usual + off, n)


@compiled
def _code_color(state, data, models, at, form, chunk, splat, known, near, fields):
    off = 0
    for f in range(form[N_COLORS]):
        n = chunk[COLORS + f]
        usual, spread = n >> 1, 0
        if known:
            usual, spread = _usual(fields, near, RED + f)
            if form[IS_BYTES]:  # channels of bytes rise and fall together, luma and chroma do not
                usual = min(max(usual + off, 0), 255)
        base = at[6] + ((f * (SPREADS + 1) + spread) * NEAR + min(length_of(abs(off)), NEAR - 1)) * SIGNED
        off = signed(state, data, models, base, fields[splat, RED + f] - usual)
        fields[splat, RED + f] = within(state, usual + off, n)


@compiled
def _code_source(state, data, models, at, name, n, splat, known, near, fields):
    """The camera or the station: whether it is the nearest neighbour's, else which."""
    column, base = CAMERA + name, at + name * (4 + (1 << TREE_BITS))
    value = fields[splat, column]
    if known:
        x, y, z = fields[near[0], column], fields[near[1], column], fields[near[2], column]
        alike = (1 if x == y else 0) + (2 if x == z else 0)
        if not bit(state, data, models, base + alike, 1 if value != x else 0):
            fields[splat, column] = x
            return
    bits = length_of(n)
    low = max(0, bits - TREE_BITS)
    high = tree(state, data, models, base + 4, bits - low, value >> low)
    found = (high << low) + even(state, data, low, value & ((1 << low) - 1))
    fields[splat, column] = within(state, found, n + 1)


@compiled
def _code_line(state, data, models, at, splat, fields):
    """The three fields of a clipline, each by the one before."""
    word, found, before = fields[splat, LINE], 0, 0
    for f in range(3):
        before = tree(state, data, models, at + ((16 * f + before) << 4), 4, (word >> 4 * f) & 15)
        found |= before << 4 * f
    fields[splat, LINE] = found


@compiled
def _code_atoms(state, data, models, at, form, entries, first, n_atoms):
    """Atoms, and weights by rank and by the upper 4 bits of the weight before."""
    bits, before = form[WEIGHT_BITS], 0
    for rank in range(n_atoms):
        entry = entries[first + rank]
        entry[0] = tree(state, data, models, at[10], form[INDEX_BITS], entry[0])
        entry[1] = tree(state, data, models, at[11] + ((16 * rank + before) << bits), bits, entry[1])
        before = entry[1] >> max(0, bits - 4)
