"""How much light a photograph lets through, as a smooth field over it: one polynomial a channel, of the gain's
logarithm.

Exposure and white balance are its constant, vignetting and veiling glare its slopes and curvature. Fitted from 20,000
splats of monstree, the median spread of a splat's colours falls by 25 % with a constant, by 35 % with slopes, by 42 %
with curvature; fountain_p11: 51, 61 and 65 %.
"""

from __future__ import annotations

import numpy as np

from pipeline.execution.compiled import kernel
from pipeline.numerics.srgb import LINEAR_OF_LEVEL, srgb_of

N_TERMS = 6  # 1, x, y, x^2, xy, y^2; x and y run over [-1, 1] across the photograph
MOST_GAIN = 4.0  # two stops; a field that goes beyond between its splats was not measured there
STEPS = 4096


def terms(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The values (..., N_TERMS) of the polynomial's terms."""
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def relit(pixels: np.ndarray, log_gain: np.ndarray) -> np.ndarray:
    """A photograph (h, w, 3) uint8 with its light times exp(log_gain (3, N_TERMS) @ terms), rounded and clipped."""
    # Indexed by the root of linear light, in which sRGB is nearly even: a step is a thirtieth of a level at most.
    by_root = 255 * srgb_of((np.arange(STEPS + 1) / STEPS) ** 2)
    result = np.empty_like(pixels)
    _relight(pixels, np.ascontiguousarray(log_gain, np.float64), np.log(MOST_GAIN), LINEAR_OF_LEVEL, by_root, result)
    return result


@kernel()
def _relight(pixels, log_gain, most, by_level, by_root, result):
    height, width = pixels.shape[:2]
    last = by_root.shape[0] - 1
    for row in range(height):
        y = (row + 0.5) * 2 / height - 1
        for column in range(width):
            x = (column + 0.5) * 2 / width - 1
            for k in range(3):
                g = log_gain[k]
                field = g[0] + g[1] * x + g[2] * y + g[3] * x * x + g[4] * x * y + g[5] * y * y
                light = by_level[pixels[row, column, k]] * np.exp(min(max(field, -most), most))
                at = int(np.sqrt(min(light, 1.0)) * last + 0.5)
                result[row, column, k] = np.uint8(by_root[at] + 0.5)
