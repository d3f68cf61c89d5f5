"""Codes of runs in few bytes: each field by adaptive binary models under a range coder.

A field is a tree of bits from the highest; each node keeps how likely its 0 is, by what went before it: a turn by the two turns before,
a step of the normal by the step before, a start by the start before. Probabilities of 12 bits move a sixteenth of the way at every bit
(Martin, Range encoding, 1979; the carry is that of LZMA). Whole numbers throughout: the same bytes everywhere.
"""

from __future__ import annotations

import numpy as np

from pipeline.execution.compiled import kernel, part
from pipeline.geometry.runs.codes import COLUMN_BITS, LENGTH_BITS, ROW_BITS, SLICE_BITS, RunCodes

TOP, MODEL, RATE = 1 << 24, 12, 4
WORD = 0xFFFFFFFF

# Where the models of each field begin, by context; a field of b bits has 2^b nodes a context.
_TURN, _NORMAL = 0, 64 * 8
_LENGTH = _NORMAL + 32 * 32
_SLICE, _SAME = _LENGTH + 32, _LENGTH + 64
_ROW, _COLUMN = _SAME + 2, _SAME + 2 + 2 * 2048
_A = _COLUMN + 2 * 2048
_B = _A + 256
_N_MODELS = _B + 256 * 8


@part()
def _encode_bit(state, out, models, at, bit):
    """`state` is low, range, waiting byte, its followers, bytes written."""
    bound = (state[1] >> MODEL) * models[at]
    if bit:
        state[0] += bound
        state[1] -= bound
        models[at] -= models[at] >> RATE
    else:
        state[1] = bound
        models[at] += ((1 << MODEL) - models[at]) >> RATE
    while state[1] < TOP:
        state[1] <<= 8
        _shift(state, out)


@part()
def _shift(state, out):
    if state[0] < 0xFF000000 or state[0] > WORD:
        carry = state[0] >> 32
        if state[2] >= 0:
            out[state[4]] = (state[2] + carry) & 255
            state[4] += 1
        while state[3] > 0:
            out[state[4]] = (255 + carry) & 255
            state[4] += 1
            state[3] -= 1
        state[2] = (state[0] >> 24) & 255
    else:
        state[3] += 1
    state[0] = (state[0] & 0x00FFFFFF) << 8


@part()
def _encode(state, out, models, base, value, bits):
    node = 1
    for shift in range(bits - 1, -1, -1):
        bit = (value >> shift) & 1
        _encode_bit(state, out, models, base + node, bit)
        node = 2 * node + bit


@part()
def _decode_bit(state, data, models, at):
    """`state` is code, range, bytes read."""
    bound = (state[1] >> MODEL) * models[at]
    if state[0] < bound:
        state[1] = bound
        models[at] += ((1 << MODEL) - models[at]) >> RATE
        bit = 0
    else:
        state[0] -= bound
        state[1] -= bound
        models[at] -= models[at] >> RATE
        bit = 1
    while state[1] < TOP:
        state[1] <<= 8
        state[0] = (state[0] << 8) | (data[state[2]] if state[2] < len(data) else 0)
        state[2] += 1
    return bit


@part()
def _decode(state, data, models, base, bits):
    node = 1
    for _ in range(bits):
        node = 2 * node + _decode_bit(state, data, models, base + node)
    return node - (1 << bits)


@kernel()
def _write(length, slice_, row, column, normal, step, out):
    models = np.full(_N_MODELS, 1 << (MODEL - 1), np.int64)
    state = np.array([0, WORD, -1, 0, 0], np.int64)
    at, before_slice, before_row, before_column = 0, 0, 0, 0
    for r in range(len(length)):
        _encode(state, out, models, _LENGTH, length[r] - 1, 5)
        _encode(state, out, models, _SLICE, (slice_[r] - before_slice) & 31, 5)
        same = int(slice_[r] == before_slice)
        _encode(state, out, models, _ROW + 2048 * same, (row[r] - before_row) & 2047, 11)
        near = same & int(abs(row[r] - before_row) < 4)
        _encode(state, out, models, _COLUMN + 2048 * near, (column[r] - before_column) & 2047, 11)
        before_slice, before_row, before_column = slice_[r], row[r], column[r]
        a = normal[r, 0] & 255
        _encode(state, out, models, _A, a, 8)
        _encode(state, out, models, _B + 256 * (a >> 5), normal[r, 1] & 255, 8)
        turns, normal_before = 0, 0
        for _ in range(length[r] - 1):
            turn, to = step[at] & 7, step[at] >> 3
            _encode(state, out, models, _TURN + 8 * turns, turn, 3)
            _encode(state, out, models, _NORMAL + 32 * normal_before, to, 5)
            turns, normal_before = ((turns << 3) | turn) & 63, to
            at += 1
    for _ in range(5):
        _shift(state, out)
    return state[4]


@kernel()
def _read(data, n_runs, length, slice_, row, column, normal, step):
    """Returns whether all steps had room."""
    models = np.full(_N_MODELS, 1 << (MODEL - 1), np.int64)
    state = np.array([0, WORD, 0], np.int64)
    for _ in range(4):
        state[0] = (state[0] << 8) | (data[state[2]] if state[2] < len(data) else 0)
        state[2] += 1
    at, before_slice, before_row, before_column = 0, 0, 0, 0
    for r in range(n_runs):
        length[r] = _decode(state, data, models, _LENGTH, 5) + 1
        slice_[r] = (before_slice + _decode(state, data, models, _SLICE, 5)) & 31
        same = int(slice_[r] == before_slice)
        row[r] = (before_row + _decode(state, data, models, _ROW + 2048 * same, 11)) & 2047
        near = same & int(abs(row[r] - before_row) < 4)
        column[r] = (before_column + _decode(state, data, models, _COLUMN + 2048 * near, 11)) & 2047
        before_slice, before_row, before_column = slice_[r], row[r], column[r]
        a = _decode(state, data, models, _A, 8)
        b = _decode(state, data, models, _B + 256 * (a >> 5), 8)
        normal[r, 0], normal[r, 1] = a - 256 if a > 127 else a, b - 256 if b > 127 else b
        turns, normal_before = 0, 0
        for _ in range(length[r] - 1):
            if at >= len(step):
                return False
            turn = _decode(state, data, models, _TURN + 8 * turns, 3)
            normal_before = _decode(state, data, models, _NORMAL + 32 * normal_before, 5)
            step[at] = turn | normal_before << 3
            turns = ((turns << 3) | turn) & 63
            at += 1
    return at == len(step)


def pack_runs(codes: RunCodes) -> np.ndarray:
    """The starts, normals and steps as bytes (n,) uint8; the groups' tables and the codebook stay as they are."""
    word = codes.start.astype(np.int64)
    column, row = word & (1 << COLUMN_BITS) - 1, word >> COLUMN_BITS & (1 << ROW_BITS) - 1
    slice_ = word >> COLUMN_BITS + ROW_BITS & (1 << SLICE_BITS) - 1
    length = (word >> COLUMN_BITS + ROW_BITS + SLICE_BITS) + 1
    out = np.empty(
        16 + 64 * len(word) + 9 * len(codes.step), np.uint8
    )  # no bit takes more than 9: probabilities end at 15 of 4,096
    n = _write(length, slice_, row, column, codes.normal.astype(np.int64), codes.step.astype(np.int64), out)
    return out[:n].copy()


def unpack_runs(data: np.ndarray, n_runs: int, n_steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The way back: `start` (n_runs,) uint32, `normal` (n_runs, 2) int8, `step` (n_steps,) uint8.

    Raises: ValueError where bytes are of other runs than promised; reads none beyond them.
    """
    length, slice_, row, column = (np.zeros(n_runs, np.int64) for _ in range(4))
    normal, step = np.zeros((n_runs, 2), np.int64), np.zeros(n_steps, np.int64)
    if not _read(data, n_runs, length, slice_, row, column, normal, step):
        raise ValueError(f"bytes of other runs than {n_runs} with {n_steps} steps")
    word = (
        column
        | row << COLUMN_BITS
        | slice_ << COLUMN_BITS + ROW_BITS
        | length - 1 << COLUMN_BITS + ROW_BITS + SLICE_BITS
    )
    assert LENGTH_BITS + SLICE_BITS + ROW_BITS + COLUMN_BITS == 32
    return word.astype(np.uint32), normal.astype(np.int8), step.astype(np.uint8)
