"""What a group's chunks have, as whole numbers: each by that of the chunk before, or by the mean of those of late.

Origins of frames are whole multiples of some power of two of their group's units, that goes with the power of two below
their cells' side, as encoders make them, and are told as those. Of floats the upper half is told by that of the chunk
before, the lower half as it stands.
"""

from __future__ import annotations

import numpy as np

from storage.packed.archive.coder import SIGNED, compiled, even, length_of, within
from storage.packed.archive.mixing import N_BASES, SIGNED_SETS, mixed_signed
from storage.packed.schema import Array, Header, arrays_of

DERIVED = "batch_count", "sizes"  # what the splats tell
_BY_MEAN = (
    "box_bits",
    "color_turn",
    "frame_turn",
    "frame_cells",
    "frame_curve",
    "normal_cells",
    "normal_slope",
    "normal_lean",
)
MEAN, PREVIOUS, FLOAT, ORIGIN = range(4)  # kinds of columns
_ORIGIN = "frame_origin"
_SIZES = 16  # of what was off, in octaves
MODELS_A_COLUMN = (1 + 2 * _SIZES) * SIGNED
_MOST_SHIFT, _ORIGINS = 15, 1 << 16


def tables_in(header: Header) -> list[Array]:
    """The arrays of chunks that are kept, in the order of the page, but origins of frames last."""
    found = [a for a in arrays_of(header) if a.dims[0] == "c" and a.name not in DERIVED]
    return sorted(found, key=lambda array: array.name == _ORIGIN)


def _width(array: Array) -> int:
    return int(array.dims[1]) if len(array.dims) > 1 else 1


def columns_of(header: Header) -> np.ndarray:
    """Of each column its kind, its smallest value, how many there are, and the column of its cells' side, (w, 4)
    int64."""
    rows: list[tuple[int, int, int, int]] = []
    step = 0
    for array in tables_in(header):
        if array.name == "frame_step":
            step = len(rows)
        if array.name == _ORIGIN or array.dtype == "float32":
            row = (ORIGIN if array.name == _ORIGIN else FLOAT, 0, 1 << 16, step)
        else:
            info = np.iinfo(array.dtype)
            row = (MEAN if array.name in _BY_MEAN else PREVIOUS, int(info.min), 1 << info.bits, step)
        rows += [row] * _width(array)
    return np.array(rows, np.int64)


def numbers_of(header: Header, arrays: dict[str, np.ndarray]) -> np.ndarray:
    """The numbers (c, w) int64 of a group's chunks, and in one more column what exponents of steps are above the powers
    of two that origins are multiples of."""
    parts, above = [], 0
    for array in tables_in(header):
        values = np.ascontiguousarray(arrays[array.name].reshape(header.n_chunks, -1))
        if array.name == _ORIGIN:
            joined = np.bitwise_or.reduce(values.astype(np.int64), axis=1) | 1 << _MOST_SHIFT
            shift = np.frexp((joined & -joined).astype(np.float64))[1] - 1
            above = max(0, int(((arrays["frame_step"] >> 7).astype(np.int64) - shift).max()))
        parts.append((values.view(np.uint32) if array.dtype == "float32" else values).astype(np.int64))
    return np.concatenate([*parts, np.full((header.n_chunks, 1), above)], axis=1)


def of_numbers(header: Header, rows: np.ndarray) -> dict[str, np.ndarray]:
    """The way back of `numbers_of`."""
    arrays: dict[str, np.ndarray] = {}
    at = 0
    for array in tables_in(header):
        shape, width = (header.n_chunks, *(int(dim) for dim in array.dims[1:])), _width(array)
        values, at = rows[:, at : at + width], at + width
        if array.dtype == "float32":
            arrays[array.name] = np.ascontiguousarray(values.astype(np.uint32)).view(np.float32).reshape(shape)
        else:
            arrays[array.name] = values.reshape(shape).astype(array.dtype)
    return arrays


@compiled
def code_tables(state, data, models, weights, base, which, columns, rows):
    """Writes or reads the numbers `rows` (c, w + 1) int64. Models begin at `base`, sets of weights at `which`."""
    n = len(columns)
    before, mean, sizes = np.zeros(n, np.int64), np.zeros(n), np.zeros(n, np.int64)
    bases = np.empty(N_BASES, np.int64)
    for chunk in range(len(rows)):
        row, left = rows[chunk], 0
        for c in range(n):
            kind, least, many = columns[c, 0], columns[c, 1], columns[c, 2]
            own = base + c * MODELS_A_COLUMN
            if kind == ORIGIN and columns[c - 1, 0] != ORIGIN:
                row[n] = even(state, data, 8, row[n]) if chunk == 0 else rows[0, n]
            bases[0] = own
            bases[1] = own + (1 + sizes[c]) * SIGNED
            bases[2] = own + (1 + _SIZES + left) * SIGNED
            at, sets = row[c], which + c * SIGNED_SETS
            if kind == ORIGIN:
                shift = min(max((row[columns[c, 3]] >> 7) - row[n], 0), _MOST_SHIFT)
                usual = before[c] >> shift
                off = mixed_signed(state, data, models, weights, bases, 3, sets, (at >> shift) - usual)
                row[c] = within(state, usual + off, _ORIGINS >> shift) << shift
                before[c] = row[c]
            elif kind == FLOAT:
                off = mixed_signed(state, data, models, weights, bases, 3, sets, (at >> 16) - before[c])
                upper = within(state, before[c] + off, many)
                row[c] = upper << 16 | even(state, data, 16, at & 0xFFFF)
                before[c] = upper
            else:
                usual = before[c] if kind == PREVIOUS else np.int64(np.floor(mean[c] + 0.5))
                off = mixed_signed(state, data, models, weights, bases, 3, sets, at - usual)
                row[c] = within(state, usual + off - least, many) + least
                before[c] = row[c]
                mean[c] += (row[c] - mean[c]) / 8
            left = sizes[c] = min(length_of(abs(off)), _SIZES - 1)
