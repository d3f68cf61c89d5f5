"""How alike two pictures are, on the pixels that a mask names: PSNR, SSIM and FLIP.

All take 8-bit sRGB as it is stored. PSNR and SSIM do not linearise: the paper's figures are of stored values too.
"""

from __future__ import annotations

import math

import numpy as np
from skimage.metrics import structural_similarity

PEAK = 255.0
BEST_DB = 100.0
SSIM_WINDOW_PX = 11  # what a Gaussian of 1.5 pixels cut off at 3.5 sigma covers


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


def ssim(a: np.ndarray, b: np.ndarray, mask: np.ndarray) -> float | None:
    """Structural similarity of `a` to the reference `b`, (height, width, 3) uint8, averaged over `mask` (height, width).

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
    # float32 halves the memory of the five filtered maps; against float64 the mean moves by 1e-8 (views of fountain_p11).
    _, similarity = structural_similarity(
        a.astype(np.float32), b.astype(np.float32), channel_axis=2, data_range=PEAK, full=True,
        gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
    )
    return float(similarity[mask].mean(dtype=np.float64))


def flip(a: np.ndarray, b: np.ndarray, mask: np.ndarray) -> float | None:
    """FLIP, the difference that a viewer sees when `a` alternates with the reference `b`, averaged over `mask`: 0 is
    none, 1 the most. For 67 pixels a degree, a screen 0.7 m away.

    Guarantees: as `ssim`; an empty mask gives None.

    References: Andersson et al., Proceedings of the ACM on Computer Graphics and Interactive Techniques 3(2), 2020.
    """
    import flip_evaluator

    _check_sizes(a, b, mask)
    if not mask.any():
        return None
    around = _rectangle(mask)
    a, b, mask = a[around], b[around], mask[around]
    a = np.where(mask[..., None], a, b)
    seen, _, _ = flip_evaluator.evaluate(
        b.astype(np.float32) / PEAK, a.astype(np.float32) / PEAK, "LDR", applyMagma=False, computeMeanError=False)
    return float(np.asarray(seen)[..., 0][mask].mean(dtype=np.float64))


def _rectangle(mask: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns around the mask with room for one window on every side, where the picture has it."""
    slices = []
    for axis, size in enumerate(mask.shape):
        used = np.flatnonzero(mask.any(axis=1 - axis))
        slices.append(slice(max(0, used[0] - SSIM_WINDOW_PX), min(size, used[-1] + 1 + SSIM_WINDOW_PX)))
    return tuple(slices)


def _check_sizes(a: np.ndarray, b: np.ndarray, mask: np.ndarray) -> None:
    assert a.dtype == b.dtype == np.uint8 and mask.dtype == bool, (a.dtype, b.dtype, mask.dtype)
    assert a.shape == b.shape == (*mask.shape, 3), (a.shape, b.shape, mask.shape)
