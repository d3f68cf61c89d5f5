"""The light fields of all photographs at once, from splats that several of them see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.effects.exposure.light import MOST_GAIN, N_TERMS, terms
from pipeline.execution.compiled import kernel
from pipeline.numerics.srgb import srgb_of

ROUNDS = 40  # of medians and fits in turn; the last of 40 moves no gain of monstree by 0.1 %
MORE_ROUNDS = 10  # from fields that are near
DARKEST, BRIGHTEST = 0.06, 0.95  # sRGB: outside, photographs tell noise or clipped light
# What each term is worth at zero, in observations: a photograph with few of them keeps an even field.
PRIOR = np.array([0.1, 3.0, 3.0, 10.0, 10.0, 10.0])
HUBER = 1.5  # in median residuals: highlights and what hides a splat must not count in full


@dataclass(frozen=True)
class Observations:
    """One row for each splat and photograph that shows it."""

    splat: np.ndarray  # (m,) int64, any numbering
    photo: np.ndarray  # (m,) int64
    x: np.ndarray  # (m,) across the photograph, -1 to 1
    y: np.ndarray  # (m,)
    light: np.ndarray  # (m, 3) linear

    def only(self, rows: np.ndarray) -> Observations:
        return Observations(self.splat[rows], self.photo[rows], self.x[rows], self.y[rows], self.light[rows])


def solve_fields(seen: Observations, n_photos: int, near: np.ndarray | None = None) -> np.ndarray:
    """Log-gain fields (n_photos, 3, N_TERMS) that make the photographs agree; the mean constant of those that show any
    splat is zero, as is all of the others.

    Iterated: the median of each splat's corrected light is its truth, and each photograph's field is fitted to the
    truths of its splats, large residuals down-weighted (Huber). From fields `near` the solution, those of some of the
    splats, it takes fewer rounds.
    """
    fields, n_rounds = (np.zeros((n_photos, 3, N_TERMS)), ROUNDS) if near is None else (near.copy(), MORE_ROUNDS)
    srgb = srgb_of(np.clip(seen.light, 0, 1))
    usable = np.all((srgb > DARKEST) & (srgb < BRIGHTEST), axis=1)
    seen = seen.only(usable)
    basis = terms(seen.x, seen.y)
    groups = [np.flatnonzero(seen.photo == i) for i in range(n_photos)]
    bases = [basis[rows] for rows in groups]
    some = [i for i, rows in enumerate(groups) if len(rows)]
    order, start = _by_splat(seen.splat)
    for channel in range(3):
        log_light = np.log(seen.light[:, channel])
        for _ in range(n_rounds if len(log_light) else 0):
            corrected = _corrected(log_light, basis, fields[:, channel], seen.photo)
            wanted = _medians(order, start, corrected) - log_light
            for i, rows in enumerate(groups):
                fields[i, channel] = _fitted(bases[i], wanted[rows], fields[i, channel])
            fields[some, channel, 0] -= fields[some, channel, 0].mean()
    return fields


def spread(seen: Observations, fields: np.ndarray | None = None) -> float:
    """Median over splats of the standard deviation of their sRGB colour across photographs, in levels of 255."""
    light = seen.light
    if fields is not None:
        basis = terms(seen.x, seen.y)
        log_gain = np.einsum("mt,mkt->mk", basis, fields[seen.photo])
        light = light * np.exp(np.clip(log_gain, -np.log(MOST_GAIN), np.log(MOST_GAIN)))
    srgb = 255 * srgb_of(np.clip(light, 0, 1))
    _, at, count = np.unique(seen.splat, return_inverse=True, return_counts=True)
    if not len(count):
        return 0.0
    mean = np.stack([np.bincount(at, srgb[:, k]) / count for k in range(3)], axis=1)
    square = np.stack([np.bincount(at, (srgb[:, k] - mean[at, k]) ** 2) / count for k in range(3)], axis=1)
    return float(np.median(np.sqrt(square).mean(axis=1)))


@kernel()
def _fitted(basis, wanted, field):
    """The field (N_TERMS,) that explains what its photograph's splats want, starting from the last one."""
    residual = np.empty(len(wanted))
    for i in range(len(wanted)):
        explained = 0.0
        for t in range(N_TERMS):
            explained += basis[i, t] * field[t]
        residual[i] = abs(wanted[i] - explained)
    scale = HUBER * np.median(residual) + 1e-9 if len(wanted) else 1.0
    normal, right = np.diag(PRIOR), np.zeros(N_TERMS)
    for i in range(len(wanted)):
        weight = 1.0 / max(1.0, residual[i] / scale)
        for t in range(N_TERMS):
            weighted = weight * basis[i, t]
            right[t] += weighted * wanted[i]
            for u in range(t + 1):
                normal[t, u] += weighted * basis[i, u]
    for t in range(N_TERMS):
        for u in range(t):
            normal[u, t] = normal[t, u]
    return np.linalg.solve(normal, right)


def _by_splat(splat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows (m,) in the order of their splats, and where each splat's begin, (s + 1,)."""
    order = np.argsort(splat, kind="stable")
    return order, np.flatnonzero(np.diff(splat[order], prepend=-1, append=-1))


@kernel()
def _corrected(log_light, basis, field, photo):
    """Light with the field (n_photos, N_TERMS) of its photograph on it, (m,), logarithmic."""
    result = np.empty(len(log_light))
    for i in range(len(log_light)):
        gain = 0.0
        for t in range(N_TERMS):
            gain += basis[i, t] * field[photo[i], t]
        result[i] = log_light[i] + gain
    return result


@kernel()
def _medians(order, start, value):
    """The median of each splat's values, at each of its rows; as many values as photographs: sorted by insertion."""
    result = np.empty(len(value))
    for s in range(len(start) - 1):
        rows = order[start[s] : start[s + 1]]
        n = len(rows)
        held = np.empty(n)
        for j in range(n):
            k = j
            while k > 0 and held[k - 1] > value[rows[j]]:
                held[k] = held[k - 1]
                k -= 1
            held[k] = value[rows[j]]
        for j in range(n):
            result[rows[j]] = (held[(n - 1) // 2] + held[n // 2]) / 2
    return result
