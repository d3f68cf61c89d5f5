"""Which iso values a volume proposes: those that its voxels pass steeply.

Along each axis neighbouring voxels a and b pass every value between them. Counted by bins of values: how many pairs pass a bin (its
surface's area in faces of voxels), and the sum of their differences |a - b|. The mean difference of a bin is the steepness of its
surface: it peaks where one material ends and another begins (Bajaj et al., The Contour Spectrum, 1997).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.execution.compiled import kernel

BINS = 256
LEAST_WORTH = 0.1  # of the best: less is noise
PLATEAU = 0.98
DIP = 0.85  # between two peaks steepness falls below so much of the lower one
MOST = 5  # values proposed
MOST_LABELS = 64  # different whole numbers from which on values are grey levels


@dataclass(frozen=True)
class Spectrum:
    """Sums by bin of values; `edges` (BINS + 1,) ascending."""

    edges: np.ndarray
    voxels: np.ndarray  # (BINS,) int64: voxels in the bin
    pairs: np.ndarray  # (BINS,) int64: pairs that pass its middle
    steps: np.ndarray  # (BINS,) float64: their summed differences


@dataclass(frozen=True)
class Proposal:
    """An iso value, the pairs of voxels that pass it, and how steeply."""

    iso: float
    pairs: int
    steepness: float  # mean difference of neighbours that pass it, in values a voxel


@kernel()
def _count(voxels, low, width, own, voxel_count, pair_delta, step_delta):
    """Adds the voxels of the first `own` slices, and their pairs with the next voxel along each axis."""
    n_k, n_j, n_i = voxels.shape
    bins = len(voxel_count)
    for k in range(min(own, n_k)):
        for j in range(n_j):
            for i in range(n_i):
                a = float(voxels[k, j, i])
                if math.isnan(a):
                    continue
                voxel_count[min(bins - 1, int((a - low) / width))] += 1
                for axis in range(3):
                    di, dj, dk = int(axis == 0), int(axis == 1), int(axis == 2)
                    if i + di >= n_i or j + dj >= n_j or k + dk >= n_k:
                        continue
                    b = float(voxels[k + dk, j + dj, i + di])
                    if math.isnan(b) or a == b:
                        continue
                    # Middles of bins in (min, max]: bin m counts where min < low + (m + .5) width <= max.
                    first = int(math.floor((min(a, b) - low) / width + 0.5))
                    end = int(math.floor((max(a, b) - low) / width + 0.5))
                    if first < end:
                        pair_delta[first] += 1
                        pair_delta[end] -= 1
                        step_delta[first] += abs(a - b)
                        step_delta[end] -= abs(a - b)


def bin_edges(low: float, high: float, whole: bool) -> np.ndarray:
    """Edges of the bins of values low..high; of whole numbers the middles of bins lie between them, as a surface should."""
    if whole:
        step = max(1, math.ceil((high - low + 1) / BINS))
        return low + step * np.arange(BINS + 1, dtype=np.float64)
    return np.linspace(low, high if high > low else low + 1, BINS + 1)


def spectrum_of(voxels: np.ndarray, own: int, edges: np.ndarray) -> Spectrum:
    """Of the first `own` slices of `voxels` (n_k, n_j, n_i), and the pairs that begin there."""
    counts, pairs, steps = np.zeros(BINS, np.int64), np.zeros(BINS + 1, np.int64), np.zeros(BINS + 1)
    _count(voxels, float(edges[0]), float(edges[1] - edges[0]), own, counts, pairs, steps)
    return Spectrum(edges, counts, pairs[:-1].cumsum(), steps[:-1].cumsum())


def labels_in(spectrum: Spectrum, whole: bool) -> np.ndarray | None:
    """The values of a volume whose values seem to be names of regions: few whole numbers, and steps between any two of them; else None."""
    if not whole or spectrum.edges[1] - spectrum.edges[0] != 1:
        return None
    used = np.flatnonzero(spectrum.voxels)
    if not 2 <= len(used) <= MOST_LABELS:
        return None
    return spectrum.edges[used]


def propose(spectrum: Spectrum, is_labels: bool) -> list[Proposal]:
    """Up to MOST values, the one with the largest steep surface first.

    Of labels one between each two neighbouring values. Else the peaks of steepness times the root of the area, between which it dips.
    """
    middle = (spectrum.edges[:-1] + spectrum.edges[1:]) / 2
    steepness = np.divide(spectrum.steps, spectrum.pairs, out=np.zeros(BINS), where=spectrum.pairs > 0)
    if is_labels:
        used = np.flatnonzero(spectrum.voxels)
        chosen = [int(i) for i in used[:-1]][:MOST]
        return [
            Proposal(
                float(spectrum.edges[i] + spectrum.edges[1] - spectrum.edges[0])
                - 0.5 * float(spectrum.edges[1] - spectrum.edges[0]),
                int(spectrum.pairs[i]),
                float(steepness[i]),
            )
            for i in chosen
        ]
    worth = steepness * np.sqrt(spectrum.pairs)  # a steep speck is no surface, nor is noise all over the volume
    smooth = np.convolve(np.pad(worth, 2, mode="edge"), np.array([1, 2, 3, 2, 1]) / 9, mode="valid")
    smooth[spectrum.pairs == 0] = 0.0
    peaks = [p for p in _peaks(smooth) if smooth[p] >= LEAST_WORTH * smooth.max()]
    peaks.sort(key=lambda p: (-smooth[p], p))
    found = (_middle_of_plateau(smooth, p) for p in peaks[:MOST])
    return [Proposal(float(middle[p]), int(spectrum.pairs[p]), float(steepness[p])) for p in found]


def _middle_of_plateau(curve: np.ndarray, p: int) -> int:
    """Of the places about p where the curve is nearly as high."""
    low = high = p
    while low > 0 and curve[low - 1] >= PLATEAU * curve[p]:
        low -= 1
    while high + 1 < len(curve) and curve[high + 1] >= PLATEAU * curve[p]:
        high += 1
    return (low + high) // 2


def _peaks(curve: np.ndarray) -> list[int]:
    """Places of maxima between which the curve dips below DIP of the lower of two neighbours."""
    found: list[int] = []
    for p in np.flatnonzero(curve > 0):
        left = curve[p - 1] if p else -1.0
        right = curve[p + 1] if p + 1 < len(curve) else -1.0
        if not (curve[p] > left and curve[p] >= right):
            continue
        while found:
            lower = min(curve[found[-1]], curve[p])
            if curve[found[-1] : p + 1].min() < DIP * lower:
                break
            if curve[found[-1]] >= curve[p]:
                p = -1  # type: ignore[assignment]
                break
            found.pop()
        if p >= 0:
            found.append(int(p))
    return found
