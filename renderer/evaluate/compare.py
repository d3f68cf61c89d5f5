"""How alike two pictures are, on the pixels that a mask names: PSNR, SSIM and FLIP.

All take 8-bit sRGB as it is stored. PSNR and SSIM do not linearise: the paper's figures are of stored values too.
"""

from __future__ import annotations

import math
from importlib.util import find_spec

import numpy as np

from pipeline.execution.compiled import kernel, part
from pipeline.numerics.accuracy import BEST_DB

PEAK = 255.0
SSIM_WINDOW_PX = 11  # what a Gaussian of 1.5 pixels cut off at 3.5 sigma covers
_REACH = SSIM_WINDOW_PX // 2
_GAUSSIAN = np.exp(-0.5 * (np.arange(-_REACH, _REACH + 1) / 1.5) ** 2)
_WINDOW = (_GAUSSIAN / _GAUSSIAN.sum()).astype(np.float32)
_C1, _C2 = (0.01 * PEAK) ** 2, (0.03 * PEAK) ** 2


def psnr_of_error(mean_squared_error: float, peak: float = PEAK) -> float:
    """PSNR in dB of a mean squared error, at most BEST_DB.

    >>> psnr_of_error(65.025)
    30.0
    """
    if mean_squared_error <= 0:
        return BEST_DB
    return min(BEST_DB, 10 * math.log10(peak * peak / mean_squared_error))


def psnr_db(a: np.ndarray, b: np.ndarray, mask: np.ndarray) -> float | None:
    """Peak signal-to-noise ratio of two pictures (height, width, 3) uint8 over the pixels of `mask` (height, width).

    The squared error is averaged over pixels and channels.

    Guarantees: pictures alike in every pixel of the mask give BEST_DB, not infinity, so that JSON can hold the figure
    and views can be averaged; an empty mask gives None; pixels outside the mask have no influence.
    """
    _check_sizes(a, b, mask)
    if not mask.any():
        return None
    difference = a[mask].astype(np.int32) - b[mask].astype(np.int32)
    return psnr_of_error(float(np.mean(difference * difference, dtype=np.float64)))


def difference(a: np.ndarray, b: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """By how much two pictures (height, width, 3) uint8 differ in each pixel, summed over channels, (height, width)
    int32; 0 outside `mask`."""
    _check_sizes(a, b, mask)
    return np.where(mask, np.abs(a.astype(np.int32) - b).sum(axis=2), 0)


def fullest_square(values: np.ndarray, side_px: int) -> tuple[float, int, int]:
    """The square of `side_px` (or of as much as there is) of `values` (height, width) with the largest sum: that sum,
    and the square's first row and column; the first of equals."""
    height, width = (min(side_px, n) for n in values.shape)
    running = np.pad(values.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    sums = running[height:, width:] - running[:-height, width:] - running[height:, :-width] + running[:-height, :-width]
    row, column = np.unravel_index(sums.argmax(), sums.shape)
    return float(sums[row, column]), int(row), int(column)


def ssim(a: np.ndarray, b: np.ndarray, mask: np.ndarray) -> float | None:
    """Structural similarity of `a` to the reference `b`, (height, width, 3) uint8, averaged over `mask` (height,
    width).

    The map is taken channel by channel with a Gaussian window of 1.5 pixels over the rectangle around the mask, and
    averaged over the mask and the channels. Outside the mask `a` takes the pixels of `b`, so a window across the
    mask's edge finds no difference there.

    Guarantees: 1 for pictures alike in every pixel of the mask; pixels of `a` outside the mask have no influence; an
    empty mask gives None, as do pictures smaller than one window.

    References: Wang, Bovik, Sheikh and Simoncelli, IEEE Transactions on Image Processing 13(4), 2004.
    """
    _check_sizes(a, b, mask)
    if not mask.any() or min(mask.shape) < SSIM_WINDOW_PX:
        return None
    around = _rectangle(mask)
    a, b, mask = a[around], b[around], mask[around]
    a = np.where(mask[..., None], a, b)
    padding = ((_REACH, _REACH), (_REACH, _REACH), (0, 0))
    a, b = (np.pad(picture, padding, mode="symmetric").astype(np.float32) for picture in (a, b))
    return _similarity(a.reshape(len(a), -1), b.reshape(len(b), -1), mask, _WINDOW) / (3 * int(mask.sum()))


@part(fastmath={"contract", "reassoc", "nsz"})
def _down_the_columns(a, b, y, window, sums):
    """Windowed sums down each column from row y on, (5, width): of a, b, a a, b b and a b."""
    sums[:] = 0
    for k in range(window.shape[0]):
        w, row_a, row_b = window[k], a[y + k], b[y + k]
        for x in range(row_a.shape[0]):
            p, q = row_a[x], row_b[x]
            sums[0, x] += w * p
            sums[1, x] += w * q
            sums[2, x] += w * p * p
            sums[3, x] += w * q * q
            sums[4, x] += w * p * q


@part(fastmath={"contract", "reassoc", "nsz"})
def _along_the_row(sums, window, means):
    for m in range(5):
        for x in range(means.shape[1]):
            means[m, x] = 0
        for k in range(window.shape[0]):
            w, first = window[k], 3 * k
            for x in range(means.shape[1]):
                means[m, x] += w * sums[m, x + first]


@kernel()
def _similarity(a, b, mask, window):
    """The sum of the SSIM map over mask (h, w) and channels; a and b (h + 10, 3 (w + 10)) float32, channels
    interleaved.

    A row at a time in the first-level cache: 5 times as fast as filtering five maps of the whole picture one by one.
    """
    height, width = mask.shape
    sums, means = np.empty((5, a.shape[1]), np.float32), np.empty((5, 3 * width), np.float32)
    total = 0.0
    for y in range(height):
        if not mask[y].any():
            continue
        _down_the_columns(a, b, y, window, sums)
        _along_the_row(sums, window, means)
        for x in range(3 * width):
            if mask[y, x // 3]:
                p, q = np.float64(means[0, x]), np.float64(means[1, x])
                both, squares = p * q, p * p + q * q
                covariance, variances = means[4, x] - both, means[2, x] + means[3, x] - squares
                total += (2 * both + _C1) * (2 * covariance + _C2) / ((squares + _C1) * (variances + _C2))
    return total


def flip(a: np.ndarray, b: np.ndarray, mask: np.ndarray) -> float | None:
    """FLIP, the difference that a viewer sees when `a` alternates with the reference `b`, averaged over `mask`: 0 is
    none, 1 the most. For 67 pixels a degree, a screen 0.7 m away.

    Guarantees: as `ssim`; an empty mask gives None, and so does a Python without the package that measures it (see
    `not_measured`).

    References: Andersson et al., Proceedings of the ACM on Computer Graphics and Interactive Techniques 3(2), 2020.
    """
    _check_sizes(a, b, mask)
    if not mask.any() or not_measured():
        return None
    import flip_evaluator

    around = _rectangle(mask)
    a, b, mask = a[around], b[around], mask[around]
    a = np.where(mask[..., None], a, b)
    seen, _, _ = flip_evaluator.evaluate(
        b.astype(np.float32) / PEAK, a.astype(np.float32) / PEAK, "LDR", applyMagma=False, computeMeanError=False
    )
    return float(np.asarray(seen)[..., 0][mask].mean(dtype=np.float64))


def not_measured() -> str | None:
    """Why FLIP is not measured here; None where it is."""
    if find_spec("flip_evaluator"):
        return None
    return (
        "FLIP was not measured: its package is not installed (pip install 'splatpress[evaluate]', Python 3.11 to 3.13)"
    )


def _rectangle(mask: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns around the mask with room for one window on every side, where the picture has it."""
    slices = []
    for axis, size in enumerate(mask.shape):
        used = np.flatnonzero(mask.any(axis=1 - axis))
        slices.append(slice(max(0, used[0] - SSIM_WINDOW_PX), min(size, used[-1] + 1 + SSIM_WINDOW_PX)))
    rows, columns = slices
    return rows, columns


def _check_sizes(a: np.ndarray, b: np.ndarray, mask: np.ndarray) -> None:
    assert a.dtype == b.dtype == np.uint8 and mask.dtype == bool, (a.dtype, b.dtype, mask.dtype)
    assert a.shape == b.shape == (*mask.shape, 3), (a.shape, b.shape, mask.shape)
