"""How much light a photograph lets through, as a smooth field over it: one polynomial a channel, of the gain's
logarithm.

Exposure and white balance are its constant, vignetting and veiling glare its slopes and curvature. Fitted from 20,000
splats of monstree, the median spread of a splat's colours falls by 25 % with a constant, by 35 % with slopes, by 42 %
with curvature; fountain_p11: 51, 61 and 65 %.
"""

from __future__ import annotations

import functools

import numpy as np

from pipeline.execution.compiled import kernel, part
from pipeline.numerics.srgb import LINEAR_OF_LEVEL, srgb_of

N_TERMS = 6  # 1, x, y, x^2, xy, y^2; x and y run over [-1, 1] across the photograph
MOST_GAIN = 4.0  # two stops; a field that goes beyond between its splats was not measured there
STEPS = 4096


def terms(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The values (..., N_TERMS) of the polynomial's terms."""
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def relit(
    pixels: np.ndarray,
    log_gain: np.ndarray,
    corner: tuple[int, int] = (0, 0),
    size_px: tuple[int, int] | None = None,
) -> np.ndarray:
    """A photograph (h, w, 3) uint8 with its light times exp(log_gain (3, N_TERMS) @ terms), rounded and clipped; or a
    window of it, whose `corner` (x, y) is in a photograph of `size_px` (width, height).

    Guarantees: a window has the bytes that it has in the whole."""
    height, width = pixels.shape[:2]
    result = np.empty_like(pixels)
    _relight(
        pixels, np.ascontiguousarray(log_gain, np.float64), *corner, *(size_px or (width, height)), *_tables(), result
    )
    return result


@functools.cache
def _tables() -> tuple[np.ndarray, np.ndarray]:
    """The root of light, in STEPS, by level, and the level by that root, in which sRGB is nearly even: a step is a
    thirtieth of a level at most."""
    by_root = 255 * srgb_of((np.arange(STEPS + 1) / STEPS) ** 2)
    return np.float32(STEPS) * np.sqrt(LINEAR_OF_LEVEL).astype(np.float32), np.floor(by_root + 0.5).astype(np.uint8)


@part(error_model="numpy")
def _root_gains(g, y, left, width, gain):
    """The root of the gain at each pixel of a row: 2^t, t within one octave, by its series to the seventh power (error
    1e-6). No sum may be reordered or contracted, so that a pixel has one gain in whatever window."""
    c, b, a = np.float32(g[0] + g[2] * y + g[5] * y * y), np.float32(g[1] + g[4] * y), np.float32(g[3])
    for i in range(gain.shape[0]):
        x = np.float32(2 * (left + i) + 1 - width) / np.float32(width)
        t = min(max(c + (b + a * x) * x, np.float32(-1)), np.float32(1))
        gain[i] = np.float32(1) + t * (
            np.float32(0.6931472)
            + t
            * (
                np.float32(0.2402265)
                + t
                * (
                    np.float32(0.05550411)
                    + t
                    * (
                        np.float32(0.009618129)
                        + t * (np.float32(0.001333356) + t * (np.float32(0.0001540353) + t * np.float32(0.00001525273)))
                    )
                )
            )
        )


@kernel(error_model="numpy")
def _relight(pixels, log_gain, left, top, width, height, by_level, by_root, result):
    n_rows, n_columns = pixels.shape[:2]
    last = np.float32(by_root.shape[0] - 1)
    halves = log_gain * (0.5 / np.log(2.0))  # of the root, to the base of 2: MOST_GAIN is 1
    gain = np.empty(n_columns, np.float32)
    for row in range(n_rows):
        y = (top + row + 0.5) * 2 / height - 1
        for k in range(3):
            _root_gains(halves[k], y, left, width, gain)
            for column in range(n_columns):
                root = min(by_level[pixels[row, column, k]] * gain[column], last)
                result[row, column, k] = by_root[np.int32(root + np.float32(0.5))]
