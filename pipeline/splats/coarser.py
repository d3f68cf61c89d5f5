"""Splats of the next coarser level: each stands for about four of the finer one that lie together.

Where the four lie in one plane they are merged: their mean by area, their mean normal. Elsewhere (an edge, a twig, a rim) the
one in their middle stands for them, so that no splat floats between two surfaces. Its area is theirs together, and more
where it would leave one of their centres uncovered. RUNS (Krueger, Schneider, Westermann 2006, section 2.6.2) draws coarser
grids of points in the same way; HPG 2021, section 5, asks for levels of detail.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.execution.compiled import kernel
from pipeline.summaries import Points
from storage.packed.levels import FEWER, n_coarser
from storage.packed.schema import CHUNK, GROUP

FLAT = 0.5  # of the mean radius: how far the four may lie off the plane of the one in their middle
ALIKE = 0.8  # cosine, about 37 degrees: how much their normals may differ
_LEVEL = np.arange(256) / 255
_LINEAR = np.where(_LEVEL <= 0.04045, _LEVEL / 12.92, ((_LEVEL + 0.055) / 1.055) ** 2.4)  # of sRGB, IEC 61966-2-1
MOST_REACH = 1.5  # of the radius of their joint area: a stray among four makes no blob


@dataclass(frozen=True)
class Coarser:
    """Splats of a level, in chunk order. Of each the one in its middle, as a row of the finer level, and what it becomes."""

    middle: np.ndarray  # (m,) int64
    cell: np.ndarray  # (n,) int64: the splat that stands for each of the finer level
    position: np.ndarray  # (m, 3) float64
    normal: np.ndarray  # (m, 3) float64, unit length, as the middle one's is turned
    radius: np.ndarray  # (m,) float64


def level_sizes(n: int, most_levels: int) -> tuple[int, ...]:
    """Splats of each level, the finest, of n, first, and at most so many coarser ones.

    >>> level_sizes(330_000, 3)
    (330000, 81920, 16384)
    >>> level_sizes(30_000, 3)
    (30000,)
    """
    sizes = [n]
    while len(sizes) <= most_levels and n_coarser(sizes[-1]):
        sizes.append(n_coarser(sizes[-1]))
    return tuple(sizes)


def first_finest(points: Points) -> int:
    """The first splat of the finest level, by the summary of a stage's points; coarser ones stand before it."""
    return sum(points.levels[:-1])


def rows_of_group(group: int, n: int) -> tuple[int, int]:
    """The splats of the finer level, of n, that a group of the next stands for: four groups; the last takes what is left."""
    first = group * FEWER * GROUP
    return first, n if (group + 1) * GROUP == n_coarser(n) else first + FEWER * GROUP


def coarser_splats(
    position: np.ndarray,  # (n, 3) float64, the splats of one group of the coarser level, in chunk order
    normal: np.ndarray,  # (n, 3), unit length, turned either way
    radius: np.ndarray,  # (n,)
) -> Coarser:
    """The GROUP splats that stand for n.

    Guarantees: every splat belongs to one cell, cells hold n / GROUP splats, one more or less; the chunks of the result are of
    consecutive splats of the finer level; centres lie within the box of their cell; equal inputs give equal results.
    """
    axes = np.ascontiguousarray(np.asarray(position, np.float64).T)
    order, first = np.arange(len(position)), np.empty(GROUP + 1, np.int64)
    ends = np.arange(GROUP // CHUNK + 1) * len(position) // (GROUP // CHUNK)
    for chunk, (start, stop) in enumerate(zip(ends, ends[1:])):
        _cells(axes, order, start, stop, first[chunk * CHUNK : (chunk + 1) * CHUNK])
    first[GROUP] = len(position)
    found = _stand_in(axes, np.asarray(normal, np.float64), np.asarray(radius, np.float64), order, first)
    cell = np.empty(len(position), np.int64)
    cell[order] = np.repeat(np.arange(GROUP), np.diff(first))
    return Coarser(found[0], cell, *found[1:])


def mean_colors(color: np.ndarray, radius: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """The colours (m, 3) uint8 of cells: the mean of their splats' (n, 3), by area and in linear light, as they would add up
    on a pixel. `cell` (n,) holds every number below m."""
    area = np.asarray(radius, np.float64) ** 2
    weight = np.bincount(cell, area)
    linear = _LINEAR[color]
    mean = np.stack([np.bincount(cell, area * linear[:, c]) / weight for c in range(3)], axis=1)
    return np.rint(255 * _to_srgb(mean)).astype(np.uint8)


def _to_srgb(linear: np.ndarray) -> np.ndarray:
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055).clip(
        0, 1
    )


@kernel()
def _cells(axes, order, start, stop, first):
    """Halve order[start:stop] along its longest axis until there are as many cells as `first` (2^k,) has rows; where each begins."""
    n_cells = len(first)
    first[0] = start
    ends = np.full(n_cells + 1, stop, np.int64)
    ends[0] = start
    step = n_cells
    while step > 1:
        half = step // 2
        for cell in range(0, n_cells, step):
            begin, end = ends[cell], ends[cell + step]
            middle = begin + (end - begin) // 2
            axis, longest = 0, -1.0
            for a in range(3):
                low, high = np.inf, -np.inf
                for i in range(begin, end):
                    low, high = min(low, axes[a, order[i]]), max(high, axes[a, order[i]])
                if high - low > longest:
                    axis, longest = a, high - low
            inside = order[begin:end]
            order[begin:end] = inside[np.argsort(axes[axis][inside], kind="mergesort")]
            ends[cell + half] = middle
        step = half
    first[:] = ends[:n_cells]


@kernel()
def _stand_in(axes, normals, radii, order, first):
    n_cells = len(first) - 1
    middle, position = np.empty(n_cells, np.int64), np.empty((n_cells, 3))
    normal, radius = np.empty((n_cells, 3)), np.empty(n_cells)
    for cell in range(n_cells):
        members = order[first[cell] : first[cell + 1]]
        best, least = members[0], np.inf
        for i in members:
            total = 0.0
            for j in members:
                total += np.sqrt(
                    (axes[0, i] - axes[0, j]) ** 2 + (axes[1, i] - axes[1, j]) ** 2 + (axes[2, i] - axes[2, j]) ** 2
                )
            if total < least:
                best, least = i, total
        area, mean_radius, flat = 0.0, 0.0, True
        for i in members:
            area += radii[i] ** 2
            mean_radius += radii[i] / len(members)
        mean, turned = np.zeros(3), np.zeros(3)
        for i in members:
            off, cosine, weight = 0.0, 0.0, radii[i] ** 2 / area
            for a in range(3):
                off += (axes[a, i] - axes[a, best]) * normals[best, a]
                cosine += normals[i, a] * normals[best, a]
            side = 1.0 if cosine >= 0 else -1.0
            if side * cosine < ALIKE:
                flat = False
            for a in range(3):
                mean[a] += weight * axes[a, i]
                turned[a] += weight * side * normals[i, a]
            if abs(off) > FLAT * mean_radius:
                flat = False
        length = np.sqrt((turned**2).sum())
        middle[cell] = best
        for a in range(3):
            position[cell, a] = mean[a] if flat else axes[a, best]
            normal[cell, a] = turned[a] / length if flat else normals[best, a]
        reach = 0.0
        for i in members:
            away = 0.0
            for a in range(3):
                away += (axes[a, i] - position[cell, a]) ** 2
            reach = max(reach, np.sqrt(away))
        joint = np.sqrt(area)
        radius[cell] = max(joint, min(reach, MOST_REACH * joint))
    return middle, position, normal, radius
