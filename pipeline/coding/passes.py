"""Which share of the training set the passes of k-SVD look at: few patches while atoms still move far, then all."""

from __future__ import annotations

COARSE = 10_000  # patches that the first passes look at
WHOLE = 4  # passes at the end that look at all


def rounds_of_passes(iterations: int, n_patches: int) -> tuple[tuple[float, int], ...]:
    """The passes over `n_patches` in rounds: the share that each pass of a round looks at, and the most passes of it.

    >>> rounds_of_passes(6, 40_000), rounds_of_passes(3, 40_000)
    (((0.25, 2), (1.0, 4)), ((1.0, 3),))
    """
    n_coarse = max(0, iterations - WHOLE) if n_patches > COARSE else 0
    coarse = ((COARSE / n_patches, n_coarse),) if n_coarse else ()
    return (*coarse, (1.0, iterations - n_coarse))


def whole_passes(iterations: int, n_patches: int) -> float:
    """How many passes over all patches take as long."""
    return sum(share * n_passes for share, n_passes in rounds_of_passes(iterations, n_patches))


def quantised_share(n_patches: int) -> float:
    """Of `n_patches`, the share that quantising looks at: as many as the first passes."""
    return min(1.0, COARSE / max(1, n_patches))
