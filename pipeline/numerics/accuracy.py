"""Errors as decibels: peak 1.0, over all texels of all splats (HPG 2021, section 4)."""

from __future__ import annotations

import math

BEST_DB = 100.0  # of textures, or pictures, that are alike: JSON has no infinity


def psnr_db(squared_error: float, n_values: float) -> float | None:
    """PSNR of a summed squared error over `n_values` values (or their summed weights), at most BEST_DB; None without
    values.

    >>> psnr_db(0.01, 100), psnr_db(0.0, 100), psnr_db(0.0, 0)
    (40.0, 100.0, None)
    """
    if n_values <= 0:
        return None
    return min(BEST_DB, -10 * math.log10(squared_error / n_values)) if squared_error > 0 else BEST_DB


def squared_error_at(target_psnr_db: float, n_values: int) -> float:
    """The summed squared error of one patch of `n_values` values at a target PSNR."""
    return n_values * 10 ** (-target_psnr_db / 10)
