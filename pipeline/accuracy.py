"""Errors as decibels: peak 1.0, over all texels of all splats (HPG 2021, section 4)."""

from __future__ import annotations

import math


def psnr_db(squared_error: float, n_values: float) -> float | None:
    """PSNR of a summed squared error over `n_values` values (or their summed weights); None without error or values."""
    if squared_error <= 0 or n_values <= 0:
        return None
    return -10 * math.log10(squared_error / n_values)


def squared_error_at(target_psnr_db: float, n_values: int) -> float:
    """The summed squared error of one patch of `n_values` values at a target PSNR."""
    return n_values * 10 ** (-target_psnr_db / 10)
