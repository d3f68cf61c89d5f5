"""What the splats of a group are, one after the other, each by the nearest of its chunk that are known already.

Steps of normals, heights and colours are told by how far they are from what those mean (near.py). Heights of boxes are
not meant themselves but where the planes through the neighbours, tilted as their normals and the splat's own, pass
below the splat. Batches, sizes, cameras, stations, atoms and weights are told by several models each, of what
neighbours and the same splat have.
"""

from __future__ import annotations

import numpy as np

from storage.packed.archive.coder import compiled, even, length_of, within
from storage.packed.archive.continued import TEXELS, continued, differing
from storage.packed.archive.mixing import N_BASES, TREE_SETS, mixed, mixed_tree
from storage.packed.archive.near import N_VALUE_MODELS, N_VALUE_SETS, NEAREST, code_value, nearest, octaves, weigh
from storage.packed.archive.squares import axes_of, octahedral
from storage.packed.archive.supports import ATOM_MODELS, N_SUPPORT_SETS, WEIGHT_MODELS, code_atoms, room_of
from storage.packed.archive.tree import COUNT_MODELS, MANY_MODELS, code_cells

# Columns of a splat.
U, V, HEIGHT, A, B, BATCH, SIZE, RED, GREEN, BLUE, CAMERA, STATION, LINE, ELLIPSOID = range(14)
N_FIELDS = 14

# What holds for all splats of a file, (N_FORMS,) int64.
N_BATCHES, SIZE_BITS, N_COLORS, IS_BYTES, N_CAMERAS, N_STATIONS, INDEX_BITS, WEIGHT_BITS, IS_BOXES, TURN_BITS = range(
    10
)
N_FORMS = 10

# Of a chunk, (c, N_CHUNK) int64: splats, cells along its axes, steps of its normals, cells of its colours, of boxes
# which axes are the first, the second and the height, and values of sizes.
COUNT, CELLS, N_A, N_B, COLORS, AXES, SIZES = 0, 1, 4, 5, 6, 9, 12
N_CHUNK = 13

TREE_BITS = 8  # bits of a camera or a station that have models; those above are even
ATOMS, LINES = 17, 8  # how many of its neighbours' atoms, in whole ones, and cliplines, in sixths, a batch is told by

# The first sets of weights of each kind of field.
W_BATCH = 6 * N_VALUE_SETS  # behind those of values
W_SIZE, W_SAME, W_SOURCE, W_LINE, W_ATOM = (W_BATCH + 32 * k for k in (1, 2, 3, 4, 7))
N_SETS = W_ATOM + N_SUPPORT_SETS
assert TREE_SETS == 32


def models_of(form: np.ndarray) -> np.ndarray:
    """Where the models of each field begin, (17,) int64; the last is how many there are."""
    n, batch_bits = int(form[N_BATCHES]), length_of(int(form[N_BATCHES]) - 1)
    levels, turns = 1 << int(form[WEIGHT_BITS]), 1 << int(form[TURN_BITS])
    atoms = 1 << int(form[INDEX_BITS]) >> int(form[TURN_BITS])
    counts = [
        COUNT_MODELS + MANY_MODELS,
        *[N_VALUE_MODELS] * 6,
        (2 * (n + 1) + (n + 1) ** 2 + 3 * 34 * 34) << batch_bits,
        (64 + 17 * 17 + 2 * 62 * 64) << 4,
        2 * (4 + 72 + 257 * 9 + 4 * 34 + (1 + 2 * 257 << TREE_BITS)),
        3 * (16 + 16 * 16) * 16,
        4 << 8,
        ATOM_MODELS * atoms + (1 + atoms) * turns,
        WEIGHT_MODELS * levels,
    ]
    return np.concatenate([[0], np.cumsum(counts)])


@compiled
def code_splats(
    state, data, models, weights, at, form, chunks, steps, kinds, looks, squares, fields, first, entries, order
):
    """Writes or reads all splats of a group: `fields` (n, N_FIELDS), and of each its atoms and weights, rows of
    `entries` (m, 2) from `first` (n,) on. `order` (n,) becomes that in which they are told. `looks` and `squares` are
    the arrays of those of continued.py and squares.py."""
    n_entries, begin, n_splats = 0, 0, len(fields)
    near, asked, off = np.zeros(NEAREST, np.int64), np.zeros(4, np.int64), np.zeros((n_splats + 1, N_FIELDS))
    away, weight, said = np.zeros(NEAREST), np.zeros(NEAREST + 1), np.zeros(NEAREST)
    bases, sees = np.zeros(N_BASES, np.int64), len(looks[0]) > 0
    along, maps, radii, lights, upright = squares
    places, own, radius = np.zeros((n_splats, 3)), np.zeros((n_splats, 6)), np.ones(n_splats)
    shown, texels = np.zeros((n_splats if sees else 0, TEXELS), np.float32), np.zeros((4, TEXELS), np.float32)
    room = room_of(len(looks[0]), form[INDEX_BITS] - form[TURN_BITS])
    for c in range(len(chunks)):
        chunk, step = chunks[c], steps[c]
        rows = order[begin : begin + chunk[COUNT]]
        code_cells(state, data, models, weights, at[0], chunk[CELLS : CELLS + 2], step, rows, fields)
        area = chunk[CELLS] * step[0] * chunk[CELLS + 1] * step[1] / chunk[COUNT]
        for i in range(len(rows)):
            splat, n = rows[i], nearest(fields, rows, i, step, near, away)
            asked[1], asked[2] = weigh(away, n, area, weight), min(length_of(i), 7) >> 1
            if form[SIZE_BITS] and chunk[SIZES] > 1:
                _code_size(
                    state, data, models, weights, at[8], form[SIZE_BITS], chunk[SIZES], splat, n, near, weight, asked[1],
                    fields, off, bases,
                )  # fmt: skip
            asked[0] = asked[3] = 0
            for f in range(3):  # the normal, then the height
                column = HEIGHT if f == 2 else A + f
                n_values = chunk[CELLS + 2] if f == 2 else chunk[N_A + f]
                for k in range(n):
                    if f == 2 and form[IS_BOXES]:
                        said[k] = _height_by(fields, splat, near[k], chunk, step)
                    else:
                        said[k] = fields[near[k], column]
                asked[3] = code_value(
                    state, data, models, weights, at[1 + f], f * N_VALUE_SETS, fields, column, n_values, splat, near, n,
                    step, weight, said, asked, off, bases,
                )  # fmt: skip
            covered, light, contrast = 0, 0.0, 0
            if sees:
                for k in range(3):
                    places[splat, k] = fields[splat, U + k] * step[k]
                a, b, u, v = fields[splat, A], fields[splat, B], fields[splat, U], fields[splat, V]
                u, v = 2 * u + 1 - chunk[CELLS], 2 * v + 1 - chunk[CELLS + 1]
                axes_of(a, b, u, v, maps[c], along[c], upright, own[splat])
                radius[splat] = radii[c, fields[splat, SIZE]]
                covered = continued(
                    places, own, radius, shown, splat, near, n, texels[0], texels[1], texels[2], texels[3]
                )
            asked[3] = 0
            for f in range(form[N_COLORS]):
                for k in range(n):
                    said[k] = fields[near[k], RED + f]
                asked[0] = asked[3] if form[IS_BYTES] else 0  # channels of bytes rise and fall together
                asked[3] = code_value(
                    state, data, models, weights, at[4 + f], (3 + f) * N_VALUE_SETS, fields, RED + f, chunk[COLORS + f],
                    splat, near, n, step, weight, said, asked, off, bases,
                )  # fmt: skip
            if sees:
                light = lights[c, 0] + lights[c, 1] * fields[splat, RED]
                light = light + lights[c, 2] * fields[splat, GREEN] + lights[c, 3] * fields[splat, BLUE]
                if form[IS_BYTES]:
                    light = 2 * (fields[splat, RED] + fields[splat, GREEN] + fields[splat, BLUE]) / 3
                squares_ = differing(texels[0], texels[1], light, room[0], room[1])
                contrast = min(1 + octaves(squares_ / covered), 33) if covered else 0
            _code_batch(
                state, data, models, weights, at[7], form, kinds, splat, n, near, weight, contrast, fields, off, bases
            )
            kind = kinds[fields[splat, BATCH]]
            for name in range(2):
                if form[N_CAMERAS + name]:
                    _code_source(
                        state, data, models, weights, at[9], name, form[N_CAMERAS + name], splat, n, near, asked[1],
                        kind, fields, bases,
                    )  # fmt: skip
            if kind[1]:
                _code_line(state, data, models, weights, at[10], splat, fields, bases)
            if kind[2]:
                _code_ellipsoid(state, data, models, weights, at[11], splat, fields, bases)
            if not state[5]:
                first[splat] = n_entries
            code_atoms(
                state, data, models, weights, at[12:14], W_ATOM, form[WEIGHT_BITS], form[TURN_BITS],
                form[INDEX_BITS] - form[TURN_BITS], looks, room, covered, light, shown[splat : splat + 1], entries,
                first[splat], kind[0], bases,
            )  # fmt: skip
            n_entries += kind[0]
        begin += chunk[COUNT]


@compiled
def _code_size(state, data, models, weights, base, bits, sizes, splat, n, near, weight, far, fields, off, bases):
    late, usual, first, second, mean = off[-1], 63, 16, 16, 61
    if n:
        first, second = fields[near[0], SIZE], fields[near[1], SIZE]
        usual, sum_ = 2 * first + second + fields[near[2], SIZE], 0.0
        for k in range(n):
            sum_ += weight[k] * fields[near[k], SIZE]
        mean = np.int64(4 * sum_ / weight[NEAREST])
    bases[0] = base + (usual << 4)
    bases[1] = base + ((64 + first * 17 + second) << 4)
    bases[2] = base + ((64 + 17 * 17 + mean * 64 + far) << 4)
    bases[3] = base + ((64 + 17 * 17 + 62 * 64 + mean * 64 + np.int64(4 * late[SIZE])) << 4)
    found = mixed_tree(state, data, models, weights, bases, 4, W_SIZE, bits, fields[splat, SIZE])
    fields[splat, SIZE] = within(state, found, sizes)
    late[SIZE] += (fields[splat, SIZE] - late[SIZE]) / 8


@compiled
def _code_batch(state, data, models, weights, begin, form, kinds, splat, n, near, weight, contrast, fields, off, bases):
    if form[N_BATCHES] > 1:
        bits, none, late = length_of(form[N_BATCHES] - 1), form[N_BATCHES], off[-1]
        first, second, atoms, lines = none, none, 0, 0
        if n:
            first, second = fields[near[0], BATCH], fields[near[1], BATCH]
            mean_atoms, mean_lines = 0.0, 0.0
            for k in range(n):
                mean_atoms += weight[k] * kinds[fields[near[k], BATCH], 0]
                mean_lines += weight[k] * kinds[fields[near[k], BATCH], 1]
            atoms = 1 + np.int64(2 * mean_atoms / weight[NEAREST])
            lines = 1 + np.int64(6 * mean_lines / weight[NEAREST])
        bases[0] = begin + ((2 * first + (1 if first == second else 0)) << bits)
        bases[1] = begin + ((2 * (none + 1) + first * (none + 1) + second) << bits)
        base = 2 * (none + 1) + (none + 1) * (none + 1)
        bases[2] = begin + ((base + atoms * 34 + lines) << bits)
        bases[3] = begin + ((base + 34 * 34 + atoms * 34 + np.int64(2 * late[BATCH])) << bits)
        bases[4] = begin + ((base + 2 * 34 * 34 + atoms * 34 + contrast) << bits)
        found = mixed_tree(state, data, models, weights, bases, 5, W_BATCH, bits, fields[splat, BATCH])
        fields[splat, BATCH] = within(state, found, form[N_BATCHES])
        late[BATCH] += (kinds[fields[splat, BATCH], 0] - late[BATCH]) / 16


@compiled
def _height_by(fields, splat, other, chunk, step):
    """The height of a splat in a box, where the plane through another passes that is tilted as both their normals."""
    n = chunk[CELLS + 2]
    own = octahedral(fields[splat, A] - 127, fields[splat, B] - 127, 127)
    at_other = octahedral(fields[other, A] - 127, fields[other, B] - 127, 127)
    normal = (own[0] + at_other[0], own[1] + at_other[1], own[2] + at_other[2])
    rise = (fields[splat, U] - fields[other, U]) * step[0] * normal[chunk[AXES]]
    rise += (fields[splat, V] - fields[other, V]) * step[1] * normal[chunk[AXES + 1]]
    across, height = step[2] * normal[chunk[AXES + 2]], np.float64(fields[other, HEIGHT])
    if abs(rise) < n * abs(across):  # so no division by 0, and nothing beyond the box
        height = min(max(height - rise / across, 0.0), n - 1.0)
    return height


@compiled
def _code_source(state, data, models, weights, base, name, n_sources, splat, n, near, far, kind, fields, bases):
    """The camera or the station: whether it is the nearest neighbour's, else which."""
    column, base = CAMERA + name, base + name * (4 + 72 + 257 * 9 + 4 * 34 + (1 + 2 * 257 << TREE_BITS))
    value, bits = fields[splat, column], length_of(n_sources)
    low = max(0, bits - TREE_BITS)
    first = second = 256
    if n:
        x, y, z = fields[near[0], column], fields[near[1], column], fields[near[2], column]
        agree, other = 0, x
        for k in range(n):
            agree += 1 if fields[near[k], column] == x else 0
            if other == x:
                other = fields[near[k], column]
        alike = (1 if x == y else 0) + (2 if x == z else 0)
        first, second = x >> low, other >> low
        bases[0] = base + alike
        bases[1] = base + 4 + agree * 8 + far - 8
        bases[2] = base + 76 + first * 9 + agree
        bases[3] = base + 76 + 257 * 9 + alike * 34 + 2 * kind[0] + kind[1]
        which = W_SAME + name
        if not mixed(state, data, models, weights, bases, 4, 0, which, 1 if value != x else 0):
            fields[splat, column] = x
            return
    trees = base + 76 + 257 * 9 + 4 * 34
    bases[0] = trees
    bases[1] = trees + (1 + first << TREE_BITS)
    bases[2] = trees + (258 + second << TREE_BITS)
    high = mixed_tree(state, data, models, weights, bases, 3, W_SOURCE, bits - low, value >> low)
    found = (high << low) + even(state, data, low, value & ((1 << low) - 1))
    fields[splat, column] = within(state, found, n_sources + 1)


@compiled
def _code_line(state, data, models, weights, base, splat, fields, bases):
    """The three fields of a clipline, each by those before."""
    word, found, before, earlier = fields[splat, LINE], 0, 0, 0
    for f in range(3):
        bases[0] = base + ((16 * f + before) << 4)
        bases[1] = base + 3 * 256 + ((256 * f + 16 * before + earlier) << 4)
        earlier = before
        before = mixed_tree(state, data, models, weights, bases, 2, W_LINE + 32 * f, 4, (word >> 4 * f) & 15)
        found |= before << 4 * f
    fields[splat, LINE] = found


@compiled
def _code_ellipsoid(state, data, models, weights, base, splat, fields, bases):
    word, found = fields[splat, ELLIPSOID], 0
    for f in range(4):
        bases[0] = base + (f << 8)
        found |= mixed_tree(state, data, models, weights, bases, 1, W_LINE, 8, (word >> 8 * f) & 255) << 8 * f
    fields[splat, ELLIPSOID] = found
