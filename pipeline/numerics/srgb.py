"""sRGB (IEC 61966-2-1) and linear light, both in [0, 1]."""

from __future__ import annotations

import numpy as np


def linear_of(srgb: np.ndarray) -> np.ndarray:
    """Linear light of sRGB."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def srgb_of(linear: np.ndarray) -> np.ndarray:
    """sRGB of linear light."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


def levels_of_linear(linear: np.ndarray) -> np.ndarray:
    """uint8 levels of sRGB of linear light, rounded and clipped."""
    return np.rint(255 * srgb_of(np.clip(linear, 0, 1))).astype(np.uint8)


LINEAR_OF_LEVEL = linear_of(np.arange(256) / 255.0)  # (256,) float64, by level of 255
