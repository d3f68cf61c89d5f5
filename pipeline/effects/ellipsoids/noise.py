"""How noisy a scan is, where it is flat: what no plane can be asked to explain."""

from __future__ import annotations

import numpy as np

NEAREST = 12
FLATTEST_SHARE = 0.25  # of neighbourhoods: the flattest quarter is taken to be flat
# The third deviation of 12 points of a noisy plane is this much below the noise's own (9 of 11 degrees of freedom are
# left after the plane), and the flattest quarter of all-flat neighbourhoods again: 10,000 random planes, measured.
SHORTFALL = 0.75


def noise_of(deviation: np.ndarray) -> float:
    """The scan's noise, a length, from third deviations (n,) of neighbourhoods of NEAREST members; 0 for none."""
    return float(np.quantile(deviation, FLATTEST_SHARE) / SHORTFALL) if len(deviation) else 0.0
