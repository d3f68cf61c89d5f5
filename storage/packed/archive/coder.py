"""Numbers in few bytes by adaptive models under a range coder. One function codes both ways, so that what reads and what
writes cannot differ: it is given a value and gives back a value, the one that it was given where it writes, the one that
it finds where it reads.

The coder is that of runs (storage/packed/runs/range_coder.py); its models learn otherwise. Of each there is a
probability of 0, in 65,536ths, and how often it was used: it moves by 1/2 of the way at first, by 1/64 in the end, so
it is soon right and then stays so (the count-based adaptation of CTW and PAQ: Mahoney, 2005, section 2).
"""

from __future__ import annotations

import numpy as np

from storage.packed.runs.range_coder import (
    MODEL_BITS,
    TOP,
    begin_reading,
    begin_writing,
    compiled,
    end_writing,
    next_byte,
    shift_out,
)

READING, WRITING = 0, 1
EVEN, MOST_USES = 1 << 15, 62
SHIFTS = np.array([1] + [2] * 2 + [3] * 4 + [4] * 8 + [5] * 16 + [6] * 32, np.int64)  # by uses
assert len(SHIFTS) == MOST_USES + 1
_PRECISION = 4  # bits of a probability beyond the 12 that the coder takes
_LEAST = 1 << _PRECISION  # so that neither bit is ever impossible
_MODE, _BROKEN = 5, 6  # places of the state, behind those of the range coder


@compiled
def begin(mode, data):
    """The state of a coder that reads `data`, or writes to it: that of the range coder, the mode, whether anything was
    read that nobody writes."""
    state = np.zeros(7, np.int64)
    if mode:
        state[:5] = begin_writing()
    else:
        state[:3] = begin_reading(data)
    state[_MODE] = mode
    return state


@compiled
def end(state, data):
    """How many bytes were written; of a reader whether it was sound and took just what there was."""
    if state[_MODE]:
        return end_writing(state, data)
    return 1 if state[_BROKEN] == 0 and state[2] == len(data) else 0


@compiled
def within(state, value, n):
    """The value where it is one of 0..n - 1; else the reader is broken, and 0."""
    if 0 <= value < n:
        return value
    state[_BROKEN] = 1
    return 0


@compiled
def coded_bit(state, data, p, value):
    """A bit that is 0 with the probability p, 4,096ths."""
    bound = (state[1] >> MODEL_BITS) * p
    if not state[_MODE]:
        value = 0 if state[0] < bound else 1
    if value:
        state[0] += bound if state[_MODE] else -bound
        state[1] -= bound
    else:
        state[1] = bound
    while state[1] < TOP:
        state[1] <<= 8
        if state[_MODE]:
            shift_out(state, data)
        else:
            state[0] = state[0] << 8 | next_byte(state, data)
    return value


@compiled
def bit(state, data, models, at, value):
    """A bit by the model at a place, which learns from it. `models` (2, m): probabilities of 0, uses."""
    p, uses = models[0, at], models[1, at]
    value = coded_bit(state, data, p >> _PRECISION, value)
    if value:
        models[0, at] = p - ((p - _LEAST) >> SHIFTS[uses])
    else:
        models[0, at] = p + ((65536 - _LEAST - p) >> SHIFTS[uses])
    models[1, at] = min(uses + 1, MOST_USES)
    return value


@compiled
def share(state, data, part, whole, value):
    """A bit that is 0 with the probability part / whole, where 0 < part < whole."""
    return coded_bit(state, data, min(max(4096 * part // whole, 1), 4095), value)


@compiled
def even(state, data, bits, value):
    """A number of bits that are as likely 0 as 1, the highest first."""
    found = 0
    for k in range(bits - 1, -1, -1):
        found = 2 * found + coded_bit(state, data, 2048, (value >> k) & 1)
    return found


@compiled
def tree(state, data, models, base, bits, value):
    """A number of `bits` bits, the highest first, each by a model of its own for every way to it: models base + 1 to
    base + 2^bits - 1."""
    node = 1
    for k in range(bits - 1, -1, -1):
        node = 2 * node + bit(state, data, models, base + node, (value >> k) & 1)
    return node - (1 << bits)


@compiled
def length_of(size):
    """Bits of a number of 0 or more."""
    n = 0
    while size >> n:
        n += 1
    return n


# A signed number takes SIGNED models: of how many bits it has one for each, in unary; its sign, its second and its third
# bit by how many those are, at most MODELLED; all other bits are even.
MOST_LENGTH, MODELLED = 34, 15
SIGN, SECOND, THIRD = MOST_LENGTH, MOST_LENGTH + 16, MOST_LENGTH + 32
SIGNED = THIRD + 32


@compiled
def signed(state, data, models, base, value):
    """A signed number of less than 2^MOST_LENGTH and its sign."""
    size, n = abs(value), 0
    length = length_of(size)
    while n < MOST_LENGTH and bit(state, data, models, base + n, 1 if n < length else 0):
        n += 1
    if n == 0:
        return 0
    by = min(n, MODELLED)
    negative, found = bit(state, data, models, base + SIGN + by, 1 if value < 0 else 0), 1
    if n > 1:
        found = 2 + bit(state, data, models, base + SECOND + by, (size >> (n - 2)) & 1)
    if n > 2:
        found = 2 * found + bit(state, data, models, base + THIRD + 2 * by + (found & 1), (size >> (n - 3)) & 1)
    if n > 3:
        found = (found << (n - 3)) + even(state, data, n - 3, size & ((1 << (n - 3)) - 1))
    return -found if negative else found
