"""An adaptive binary range coder: each bit by how likely it was, in whole numbers of 32 bits.

A model is a probability of 0 in 4,096ths; it moves a sixteenth of the way at every bit (Martin, Range encoding, 1979;
the carry is that of LZMA). A reader needs products of 20 by 12 bits and unsigned comparisons, nothing wider.
"""

from __future__ import annotations

import numba
import numpy as np

from storage.compile_once import compile_once

TOP, MODEL_BITS, RATE = 1 << 24, 12, 4
EVEN = 1 << MODEL_BITS - 1
_WORD = 0xFFFFFFFF

compiled = lambda function: compile_once(numba.njit(cache=True, nogil=True)(function))


@compiled
def begin_writing():
    """State: low, range, the byte that waits (-1: none), how many 255 follow it, bytes written."""
    return np.array([0, _WORD, -1, 0, 0], np.int64)


@compiled
def begin_reading(data):
    """State: code, range, bytes read."""
    state = np.array([0, _WORD, 0], np.int64)
    for _ in range(4):
        state[0] = state[0] << 8 | next_byte(state, data)
    return state


@compiled
def next_byte(state, data):
    """The byte that a reader takes next, 0 beyond the end."""
    at = state[2]
    state[2] += 1
    return np.int64(data[at]) if at < len(data) else np.int64(0)


@compiled
def shift_out(state, out):
    """A writer's highest byte goes out, or waits for a carry."""
    if state[0] < 0xFF000000 or state[0] > _WORD:
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


@compiled
def end_writing(state, out):
    """Returns the bytes written: as many as a reader of the same bits reads."""
    for _ in range(5):
        shift_out(state, out)
    return state[4]


@compiled
def write_even(state, out, value, bits):
    """Bits that are as likely 0 as 1, the highest first."""
    for shift in range(bits - 1, -1, -1):
        state[1] >>= 1
        state[0] += state[1] * ((value >> shift) & 1)
        while state[1] < TOP:
            state[1] <<= 8
            shift_out(state, out)


@compiled
def read_even(state, data, bits):
    """The way back of `write_even`."""
    value = 0
    for _ in range(bits):
        state[1] >>= 1
        bit = np.int64(state[0] >= state[1])
        state[0] -= state[1] * bit
        value = 2 * value + bit
        while state[1] < TOP:
            state[1] <<= 8
            state[0] = state[0] << 8 | next_byte(state, data)
    return value


@compiled
def write_bit(state, out, models, at, bit):
    """A bit by the model at a place, which learns from it."""
    bound = (state[1] >> MODEL_BITS) * models[at]
    if bit:
        state[0] += bound
        state[1] -= bound
        models[at] -= models[at] >> RATE
    else:
        state[1] = bound
        models[at] += ((1 << MODEL_BITS) - models[at]) >> RATE
    while state[1] < TOP:
        state[1] <<= 8
        shift_out(state, out)


@compiled
def read_bit(state, data, models, at):
    """The way back of `write_bit`."""
    bound = (state[1] >> MODEL_BITS) * models[at]
    if state[0] < bound:
        state[1] = bound
        models[at] += ((1 << MODEL_BITS) - models[at]) >> RATE
        bit = 0
    else:
        state[0] -= bound
        state[1] -= bound
        models[at] -= models[at] >> RATE
        bit = 1
    while state[1] < TOP:
        state[1] <<= 8
        state[0] = state[0] << 8 | next_byte(state, data)
    return bit


@compiled
def write_tree(state, out, models, base, value, bits):
    """A number of `bits` bits, the highest first, each by a model of its own for every way to it: models base + 1 to
    base + 2^bits - 1."""
    node = 1
    for shift in range(bits - 1, -1, -1):
        bit = (value >> shift) & 1
        write_bit(state, out, models, base + node, bit)
        node = 2 * node + bit


@compiled
def read_tree(state, data, models, base, bits):
    """The way back of `write_tree`."""
    node = 1
    for _ in range(bits):
        node = 2 * node + read_bit(state, data, models, base + node)
    return node - (1 << bits)


# A signed number takes SIGNED models: a tree of how many bits its size has (0..15), its sign, then the size's bits
# below the highest: two of them by models, the others even.
SIGNED = 80
_SIGN, _SECOND, _THIRD = 16, 32, 48


@compiled
def write_signed(state, out, models, base, value):
    """A signed number of at most 15 bits and its sign."""
    size, n = abs(value), 0
    while size >> n:
        n += 1
    write_tree(state, out, models, base, n, 4)
    if n:
        write_bit(state, out, models, base + _SIGN + n, 1 if value < 0 else 0)
    if n > 1:
        second = (size >> (n - 2)) & 1
        write_bit(state, out, models, base + _SECOND + n, second)
        if n > 2:
            write_bit(state, out, models, base + _THIRD + 2 * n + second, (size >> (n - 3)) & 1)
        if n > 3:
            write_even(state, out, size, n - 3)


@compiled
def read_signed(state, data, models, base):
    """The way back of `write_signed`."""
    n = read_tree(state, data, models, base, 4)
    if n == 0:
        return 0
    negative, size = read_bit(state, data, models, base + _SIGN + n), 1
    if n > 1:
        size = 2 + read_bit(state, data, models, base + _SECOND + n)
        if n > 2:
            size = 2 * size + read_bit(state, data, models, base + _THIRD + 2 * n + (size & 1))
        if n > 3:
            size = (size << (n - 3)) + read_even(state, data, n - 3)
    return -size if negative else size
