"""Corners of flat things, which are discs: within the reach they look like the end of a ribbon, further out they go on
widening.

A right angle of a sheet fills a quarter turn at any distance; a ribbon's end, and what crosses it, ever narrower arcs.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.effects.ellipsoids.fit import moments, principal_axes
from pipeline.effects.ellipsoids.neighbourhoods import Neighbourhood
from pipeline.execution.compiled import kernel

# Tuned on squares and on ribbons of 1 to 2.8 radii in width, ropes that cross at 30 to 90 degrees, seeds 0 to 3.
WIDENS = 1.35  # second deviations in twice the reach against the reach: corners 1.5 to 2.0, ribbons 1.0 to 1.2
SECTORS = 24
LEAST_RUN = 5  # sectors of 15 degrees in a row; ropes that cross fill up to 4


def are_corners(
    further: Neighbourhood, deviation: np.ndarray, least: float, inner: float, flatness: float
) -> np.ndarray:
    """Which neighbourhoods are corners of flat things, (n,) bool.

    `further` in twice the reach, `deviation` (n, 3) in the reach, whose second is `least` or more: less is a line.
    Members nearer than `inner` say nothing of directions; `flatness` is the largest third deviation of what is flat.
    """
    _, covariance = moments(further.offset, further.count)
    wider, axes = principal_axes(covariance)
    flat = (wider[:, 2] <= flatness) & (deviation[:, 2] <= flatness)
    widens = wider[:, 1] >= WIDENS * deviation[:, 1]
    found = np.zeros(len(deviation), bool)
    rows = np.flatnonzero(flat & widens & (deviation[:, 1] >= least))
    found[rows] = _longest_runs(further.offset[rows], further.count[rows], axes[rows], inner) >= LEAST_RUN
    return found


@kernel(error_model="numpy")
def _longest_runs(offset, count, axes, inner):
    """The most sectors in a row, around the turn, that hold a member further away than `inner`, (n,) int64."""
    runs = np.zeros(len(offset), np.int64)
    for i in range(len(offset)):
        there = np.zeros(SECTORS, np.bool_)
        for j in range(count[i]):
            x = y = 0.0
            for k in range(3):
                x += offset[i, j, k] * axes[i, 0, k]
                y += offset[i, j, k] * axes[i, 1, k]
            if x * x + y * y >= inner * inner:
                there[int((math.atan2(y, x) / (2 * math.pi) + 1) * SECTORS) % SECTORS] = True
        run = 0
        for s in range(2 * SECTORS):
            run = run + 1 if there[s % SECTORS] else 0
            runs[i] = min(SECTORS, max(runs[i], run))
    return runs
