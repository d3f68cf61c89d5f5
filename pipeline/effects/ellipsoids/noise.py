"""How noisy a scan is, where it is flat: what no plane can be asked to explain."""

from __future__ import annotations

import numpy as np

from pipeline.effects.ellipsoids.fit import moments, principal_axes
from pipeline.effects.ellipsoids.neighbourhoods import Neighbourhood

NEAREST = 12
FLATTEST_SHARE = 0.25  # of neighbourhoods: the flattest quarter is taken to be flat
# The third deviation of 12 points of a noisy plane is this much below the noise's own (9 of 11 degrees of freedom are
# left after the plane), and the flattest quarter of all-flat neighbourhoods again: 10,000 random planes, measured.
SHORTFALL = 0.75
BINS = 256  # of the histogram of third deviations, up to a radius


def thirds_of(around: Neighbourhood) -> np.ndarray:
    """Third deviations (m,) of the NEAREST members of the neighbourhoods that have so many."""
    rows = around.count >= NEAREST
    count = np.full(int(rows.sum()), NEAREST)
    return principal_axes(moments(around.offset[rows, :NEAREST], count)[1])[0][:, 2]


def histogram_of(third_radii: np.ndarray) -> np.ndarray:
    """Third radii, as shares of a splat's radius, counted in BINS bins from 0 to 1."""
    return np.histogram(np.minimum(third_radii, 1.0), BINS, (0.0, 1.0))[0]


def noise_radii(histogram: np.ndarray) -> float:
    """The scan's noise in splat radii, from a histogram (BINS,) of third deviations in radii; 0 for none."""
    running = np.concatenate([[0], np.cumsum(histogram)])
    if not running[-1]:
        return 0.0
    return float(np.interp(FLATTEST_SHARE * running[-1], running, np.arange(BINS + 1) / BINS) / SHORTFALL)
