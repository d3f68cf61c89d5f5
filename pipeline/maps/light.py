"""The light of stations: one gain a channel, so that a surface which two of them saw has one colour."""

from __future__ import annotations

import numpy as np

from pipeline.numerics.srgb import LINEAR_OF_LEVEL, srgb_of


def levels_with(log_gain: tuple[float, float, float]) -> np.ndarray:
    """The levels (256, 3) float64 that levels of 255 become under a gain of linear light, by channel."""
    light = LINEAR_OF_LEVEL[:, None] * np.exp(np.asarray(log_gain, np.float64))
    return 255 * srgb_of(np.clip(light, 0, 1))
