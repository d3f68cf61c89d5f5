"""Bits by several models at once under the coder of coder.py: what each says is weighed in the logistic domain, and the
weights learn from every bit, so models of any kind of neighbourhood may be asked, and those that know best are heard.

A *place* is a row of `models` (m, 2) uint16: the probability of 0 in 65,536ths, and how often it was used; each learns
as those of coder.py do. A *set* is a row of `weights` (s, MOST_WEIGHTS) int64 in 65,536ths, one for each place that is
asked, and one for what may be known besides. All is in whole numbers, so that every machine finds the same.

Paper: Mahoney, "Adaptive weighing of context models for lossless data compression", Florida Tech. CS-2005-16, 2005.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from storage.packed.archive.coder import (
    EVEN,
    MODELLED,
    MOST_LENGTH,
    MOST_USES,
    SECOND,
    SHIFTS,
    SIGN,
    SIGNED,
    THIRD,
    coded_bit,
    compiled,
    even,
    length_of,
)

MOST_PLACES = 6
SAID = MOST_PLACES  # of a set, the weight of what is said by other than models
MOST_WEIGHTS = MOST_PLACES + 1
N_BASES = 2 * MOST_PLACES  # of an array of bases; behind them stands what their models said
MOST_COUNTED = 65535  # uses of a model
FRESH = 1 << 14  # of a weight, 65,536ths
_ZERO, _KNOWN = 16, 7  # the byte that says a weight of 0; uses that a model counts for of which a file knows
_HALF = 2048  # of the logistic domain, in 256ths, and of probabilities, in 4,096ths
_LEARNED = 12  # a weight grows by error times what its place said, by 2 to the power of this
SQUASH = np.clip(np.rint(4096 / (1 + np.exp(-np.arange(-_HALF, _HALF) / 256))), 1, 4095).astype(np.int16)
_P = np.append(0.5, np.arange(1.0, 4096))
STRETCH = np.rint(256 * np.log(_P / (4096 - _P))).clip(1 - _HALF, _HALF - 1).astype(np.int16)
assert SIGNED == 98

# Sets of weights of a signed number: of its length by the bit, then of its sign, of its second and of its third bit.
LENGTHS = 12
SIGNED_SETS = LENGTHS + 3
TREE_SETS = 32  # of a tree, by the node


@dataclass(frozen=True)
class Models:
    """Models (m, 2) uint16 and weights (s, MOST_WEIGHTS) int64, which learn as numbers are coded."""

    models: np.ndarray
    weights: np.ndarray

    @property
    def pair(self) -> tuple[np.ndarray, np.ndarray]:
        return self.models, self.weights

    @property
    def n_known(self) -> int:
        """Bytes of `known`."""
        return len(self.models) + self.weights.size

    def known(self, least_uses: int) -> np.ndarray:
        """What was learned, (n_known,) uint8: of models that were used so often 8 and the logarithm of how likely 0 is
        against 1, 0 of others; then of weights that moved 16 and 16ths."""
        often = self.models[:, 1] >= least_uses
        p = np.where(often, (STRETCH[self.models[:, 0] >> 4].astype(np.int64) + 128 >> 8).clip(-7, 7) + 8, 0)
        w = np.where(self.weights == FRESH, 0, ((self.weights + 2048 >> 12) + _ZERO).clip(1, 63))
        return np.concatenate([p, w.ravel()]).astype(np.uint8)

    def begun(self, known: np.ndarray) -> Models:
        """Fresh models that begin with what `known` says."""
        models, weights, said = self.models.copy(), self.weights.copy(), known[: len(self.models)]
        learned = known[len(models) :].reshape(weights.shape)
        models[said > 0, 0] = SQUASH[((said[said > 0].astype(int) - 8) << 8) + _HALF].astype(np.int64) << 4
        models[said > 0, 1] = _KNOWN
        weights[learned > 0] = (learned[learned > 0].astype(np.int64) - _ZERO) << 12
        return Models(models, weights)


def fresh_models(n: int, n_sets: int) -> Models:
    """Models and sets of weights that know nothing."""
    return Models(np.tile(np.array([EVEN, 0], np.uint16), (n, 1)), np.full((n_sets, MOST_WEIGHTS), FRESH, np.int64))


@compiled
def learn(models, at, value):
    """The model at a place learns that a bit was `value`."""
    p, uses = np.int64(models[at, 0]), np.int64(models[at, 1])
    if value:
        models[at, 0] = p - ((p - 16) >> SHIFTS[min(uses, MOST_USES)])
    else:
        models[at, 0] = p + ((65520 - p) >> SHIFTS[min(uses, MOST_USES)])
    models[at, 1] = min(uses + 1, MOST_COUNTED)


@compiled
def mixed(state, data, models, weights, bases, n, model, which, value, said=0):
    """A bit by the models `model` rows after the first `n` of `bases`, weighed by the set `which`, and what is `said`
    of it besides, in the logistic domain; all of them learn from it. One alone is taken as it is."""
    if n == 1:
        at = bases[0] + model
        value = coded_bit(state, data, np.int64(models[at, 0]) >> 4, value)
        learn(models, at, value)
        return value
    total = 0
    for k in range(n):
        bases[MOST_PLACES + k] = STRETCH[models[bases[k] + model, 0] >> 4]
        total += weights[which, k] * bases[MOST_PLACES + k]
    if said:
        total += weights[which, SAID] * said
    total = total * (MOST_PLACES // n) >> 16
    p = np.int64(SQUASH[min(max(total, 1 - _HALF), _HALF - 1) + _HALF])
    value = coded_bit(state, data, p, value)
    error = (0 if value else 4096) - p
    for k in range(n):
        at = bases[k] + model
        weights[which, k] += (bases[MOST_PLACES + k] * error + (1 << (_LEARNED - 1))) >> _LEARNED
        learn(models, at, value)
    if said:
        weights[which, SAID] += (said * error + (1 << (_LEARNED - 1))) >> _LEARNED
    return value


@compiled
def mixed_tree(state, data, models, weights, bases, n, which, bits, value):
    """A number of `bits` bits, the highest first; models of each way to a bit are one after the other from each of
    `bases` on, and sets from `which` on for the first TREE_SETS of them."""
    node = 1
    for k in range(bits - 1, -1, -1):
        set_ = which + min(node, TREE_SETS - 1)
        node = 2 * node + mixed(state, data, models, weights, bases, n, node, set_, (value >> k) & 1)
    return node - (1 << bits)


@compiled
def mixed_signed(state, data, models, weights, bases, n, which, value):
    """A signed number, as `signed` of coder.py has it, each bit by the models from each of `bases` on."""
    size, length = abs(value), 0
    whole = length_of(size)
    while length < MOST_LENGTH:
        more, set_ = 1 if length < whole else 0, which + min(length, LENGTHS - 1)
        if not mixed(state, data, models, weights, bases, n, length, set_, more):
            break
        length += 1
    if length == 0:
        return 0
    by, which, found = min(length, MODELLED), which + LENGTHS, 1
    negative = mixed(state, data, models, weights, bases, n, SIGN + by, which, 1 if value < 0 else 0)
    if length > 1:
        second = (size >> (length - 2)) & 1
        found = 2 + mixed(state, data, models, weights, bases, n, SECOND + by, which + 1, second)
    if length > 2:
        third, model = (size >> (length - 3)) & 1, THIRD + 2 * by + (found & 1)
        found = 2 * found + mixed(state, data, models, weights, bases, n, model, which + 2, third)
    if length > 3:
        found = (found << (length - 3)) + even(state, data, length - 3, size & ((1 << (length - 3)) - 1))
    return -found if negative else found
