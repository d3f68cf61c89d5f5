"""Patches as coefficients of their principal components: shorter by 10 to 50 times, and learned from at that length.

Photographs of surfaces are smooth: 64 of 3,072 components keep 50 dB of `fountain_p11`, 128 keep 54. What the
components leave of a patch is orthogonal to all that happens in them, so squared errors there and the rest of each
patch add up to squared errors of the whole patch, and nothing that is reported needs the whole patch again.
"""

from __future__ import annotations

import numpy as np

from pipeline.coding.omp_kernels import squared_norms
from pipeline.coding.search.stepwise import principal_components

LADDER = (64, 256, 1024)  # how many are looked for; the first that reach the floor are then cut to what it takes
STEP = 32  # components come in whole vector registers
HALF = 2048  # rows of a sample from which halves, one to find components and one to measure them, differ little


def find_components(sample: np.ndarray, floor: float) -> tuple[np.ndarray, float]:
    """Orthonormal components (d, p) float32 of a sample (m, d) of patches that leave at most `floor` of a patch's
    squared norm on average, and what they leave. The fewest, in steps of STEP; the most of LADDER where those do not
    suffice.

    They are found from every second patch and measured on the others, where there are enough to do so.
    """
    shown, unseen = (sample[::2], sample[1::2]) if len(sample) >= 2 * HALF else (sample, sample)
    energy = squared_norms(unseen).mean()
    for n in LADDER:
        basis = principal_components(shown, min(n, sample.shape[1]))
        kept = np.cumsum(np.square(unseen @ basis, dtype=np.float64).mean(axis=0))
        if energy - kept[-1] <= floor or basis.shape[1] == sample.shape[1]:
            break
    enough = np.flatnonzero(energy - kept <= floor)
    fewest = enough[0] + 1 if len(enough) else basis.shape[1]
    used = min(basis.shape[1], -(-int(fewest) // STEP) * STEP)
    return np.ascontiguousarray(basis[:, :used]), float(max(energy - kept[used - 1], 0.0))


def project(patches: np.ndarray, basis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (n, p) float32 of patches (n, d) float32, and the squared norm (n,) float64 of each one's rest."""
    coefficients = patches @ basis
    return coefficients, np.maximum(squared_norms(patches) - squared_norms(coefficients), 0.0)


def lift(rows: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Back to whole patches or atoms (n, d) float32; unit rows stay unit rows."""
    return rows @ basis.T


def halves_suffice(coefficients: np.ndarray, floor: float) -> bool:
    """Whether rounding to float16 stays below a hundredth of `floor`, the squared norm that is left on average."""
    if np.abs(coefficients).max(initial=0) > np.finfo(np.float16).max:
        return False
    rounded = coefficients.astype(np.float16).astype(np.float32)
    return bool(squared_norms(coefficients - rounded).mean() <= 0.01 * floor)
