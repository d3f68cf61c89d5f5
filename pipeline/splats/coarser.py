"""Splats of the next coarser level: each stands for some of the finer one that lie together, on average four.

Cells are of one size, not of one number: of a chunk's splats the cell that is spread furthest is parted next (a
tree-structured quantiser: Gersho and Gray, Vector Quantization and Signal Compression, section 12.4). So rims, twigs
and strays keep splats that even counts spend where points are dense. PSNR to the finest level's pictures of a quarter
and a twentieth (benchmarks/levels.py): conference_room 29.7 and 27.4 dB for 28.8 and 25.9 of equal counts. Normals or
colours among what is spread change nothing (0.1 dB).

Where the four lie in one plane they are merged: their mean by area, their mean normal. Elsewhere (an edge, a twig, a
rim) the one in their middle stands for them, so that no splat floats between two surfaces. Its area is theirs together,
and more where it would leave one of their centres uncovered. RUNS (Krueger, Schneider, Westermann 2006, section 2.6.2)
draws coarser grids of points in the same way; HPG 2021, section 5, asks for levels of detail.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.execution.compiled import kernel, part
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
    """Splats of a level, in chunk order. Of each the one in its middle, as a row of the finer level, and what it
    becomes."""

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
    """The splats of the finer level, of n, that a group of the next stands for: four groups; the last takes what is
    left."""
    first = group * FEWER * GROUP
    return first, n if (group + 1) * GROUP == n_coarser(n) else first + FEWER * GROUP


def coarser_splats(
    position: np.ndarray,  # (n, 3) float64, the splats of one group of the coarser level, in chunk order
    normal: np.ndarray,  # (n, 3), unit length, turned either way
    radius: np.ndarray,  # (n,)
) -> Coarser:
    """The GROUP splats that stand for n.

    Guarantees: every splat belongs to one cell, and none is empty; the chunks of the result are of consecutive splats
    of the finer level, equally many; centres lie within the box of their cell; equal inputs give equal results.
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
    """The colours (m, 3) uint8 of cells: the mean of their splats' (n, 3), by area and in linear light, as they would
    add up on a pixel. `cell` (n,) holds every number below m."""
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
    """Part order[start:stop] into as many cells as `first` has rows, at the mean of the longest axis of the one whose
    splats lie furthest from theirs, by the sum of squares; where each begins."""
    n_cells = len(first)
    begin, end, spare = np.empty(n_cells, np.int64), np.empty(n_cells, np.int64), np.empty(stop - start, np.int64)
    spread, axis, middle = np.empty(n_cells), np.empty(n_cells, np.int64), np.empty(n_cells)
    begin[0], end[0], widest = start, stop, 0
    for n in range(1, n_cells):
        for cell in (widest, n - 1):
            spread[cell], axis[cell], middle[cell] = _spread(axes, order, begin[cell], end[cell])
        widest = 0
        for cell in range(1, n):
            more = end[cell] - begin[cell] - end[widest] + begin[widest]
            if spread[cell] > spread[widest] or (spread[cell] == spread[widest] and more > 0):
                widest = cell
        at, n_above = begin[widest], 0
        for i in range(begin[widest], end[widest]):
            splat = order[i]
            if axes[axis[widest], splat] < middle[widest]:
                order[at] = splat
                at += 1
            else:
                spare[n_above] = splat
                n_above += 1
        order[at : at + n_above] = spare[:n_above]
        if at == begin[widest] or at == end[widest]:  # all in one place
            at = begin[widest] + (end[widest] - begin[widest]) // 2
        begin[n], end[n], end[widest] = at, end[widest], at
    first[:] = np.sort(begin)


@part()
def _spread(axes, order, begin, end):
    """The sum of squares of the splats order[begin:end] about their mean, -1 of one alone; the axis with most of it,
    and the mean on it."""
    if end - begin < 2:
        return -1.0, 0, 0.0
    total, most, axis, middle = 0.0, -1.0, 0, 0.0
    for a in range(3):
        base, mean, squares = axes[a, order[begin]], 0.0, 0.0  # against one of them: equal ones have no spread
        for i in range(begin, end):
            mean += axes[a, order[i]] - base
        mean /= end - begin
        for i in range(begin, end):
            squares += (axes[a, order[i]] - base - mean) ** 2
        total += squares
        if squares > most:
            most, axis, middle = squares, a, base + mean
    return total, axis, middle


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
