"""The cliplines of all splats, from the nearest points of the eye that each was textured from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.effects.block import Block, Sources
from pipeline.effects.cliplines.eyes import Eye, cell_of, eye_of_splats, eyes_of
from pipeline.effects.cliplines.lines import best_lines, disc_points
from pipeline.effects.cliplines.nearest import Scales
from pipeline.execution.compiled import kernel
from pipeline.summaries import Clipped
from storage.work import arrays, tiles, work

ROWS = 2048  # splats at a time
# How far from a splat's plane a point belongs to another surface, in radii; and the share of a disc's weight that its
# line must gain. Tuned on fountain_p11 (draft; 3 views of 768 px): gain of PSNR against the photographs and share of
# splats for 1.5 radii and 0.08: 0.08 dB, 3.5 %; 1 and 0.08: 0.10 dB, 8.1 %; 0.75 and 0.08: 0.11 dB, 12 %; 0.5 and 0.08:
# 0.13 dB, 20 %. 1 and 0.12 clips 5.9 %, the paper's share.
FOREIGN_RADII = 1.0
LEAST_GAIN = 0.12


@dataclass(frozen=True)
class ClippedBlock:
    """What a task tells of its block."""

    n_splats: int
    n_clipped: int


@dataclass(frozen=True)
class Cliplines:
    """A task a block. Arrays: has_clipline (n,) bool, clipline (n,) uint32."""

    sources: Sources
    nearest: Path
    foreign_radii: float = FOREIGN_RADII
    least_gain: float = LEAST_GAIN
    name = "cliplines"

    def init(self, folder: Path) -> int:
        n = self.sources.n_splats
        arrays.create(folder, "has_clipline", (n,), "bool")
        arrays.create(folder, "clipline", (n,), "uint32")
        return arrays.n_blocks(n)

    def run(self, folder: Path, index: int) -> ClippedBlock:
        block = self.sources.block(index)
        code, has = cliplines_of(block, self.nearest, self.foreign_radii, self.least_gain)
        arrays.write(folder, "has_clipline", block.rows[0], has)
        arrays.write(folder, "clipline", block.rows[0], code)
        return ClippedBlock(n_splats=len(has), n_clipped=int(has.sum()))

    def finalise(self, folder: Path, results: list[ClippedBlock]) -> Clipped:
        return Clipped(sum(r.n_clipped for r in results))


def cliplines_of(
    block: Block, nearest: Path, foreign_radii: float = FOREIGN_RADII, least_gain: float = LEAST_GAIN, every: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Codes (n,) uint32 of the splats of a block, and which are worth one, (n,) bool; of every n-th splat, zeros
    between."""
    code, has = np.zeros(len(block.centre), np.uint32), np.zeros(len(block.centre), bool)
    eye = np.where(np.arange(len(code)) % every, -1, eye_of_splats(block))
    eyes, scales = eyes_of(block.sources), work.summary(nearest, Scales).scale
    for i in np.unique(eye[eye >= 0]):
        every_row = np.flatnonzero(eye == i)
        view = View(eyes[i], scales[i], tiles.shape_of(nearest, f"nearest_{i}")[:2])
        top, bottom, left, right = _cells_of(block, every_row, view)
        if top >= bottom:
            continue
        known = tiles.read_tiles(nearest, f"nearest_{i}", top, bottom, left, right)
        for rows in _pieces(every_row):
            foreign = _foreign(block, rows, view, known, (top, left), foreign_radii)
            some = rows[foreign.any(axis=1)]
            code[some], gain = best_lines(foreign[foreign.any(axis=1)])
            has[some] = gain >= least_gain
    code[~has] = 0
    return code, has


@dataclass(frozen=True)
class View:
    """The picture of nearest points of an eye."""

    eye: Eye
    scale: float
    shape: tuple[int, int]  # height and width, in cells


def _pieces(rows: np.ndarray) -> list[np.ndarray]:
    return [rows[at : at + ROWS] for at in range(0, len(rows), ROWS)]


def _cells_of(block: Block, rows: np.ndarray, view: View) -> tuple[int, int, int, int]:
    """Top, bottom, left and right of the cells that the points of these discs fall into; none where top is bottom."""
    bounds = np.array([view.shape[0], 0, view.shape[1], 0])
    _bound(
        bounds, rows, *_discs(block), view.eye.numbers, view.eye.around, view.scale, block.sources.origin, view.shape
    )
    return tuple(bounds.tolist())


def _discs(block: Block) -> tuple[np.ndarray, ...]:
    u, v, _ = block.frame
    return block.centre, u, v, disc_points()[0], block.radius


def _foreign(
    block: Block, rows: np.ndarray, view: View, known: np.ndarray, corner: tuple[int, int], foreign_radii: float
) -> np.ndarray:
    """Which of the disc's points belong to another surface, (n, m) bool; `known` is the part of the view's picture from
    the cell `corner` (row, column) on that these discs fall into."""
    foreign = np.zeros((len(rows), len(disc_points()[0])), bool)
    eye, origin = view.eye, block.sources.origin
    seen = eye.numbers, eye.around, view.scale, origin, view.shape
    _look_up(foreign, rows, *_discs(block), block.frame[2], foreign_radii, *seen, known, *corner)
    return foreign


@kernel(error_model="numpy")
def _bound(bounds, rows, centre, u, v, points, radius, eye, around, scale, origin, shape):
    """Top, bottom, left and right of the cells of all discs' points, into `bounds` (4,)."""
    height, width = shape
    top, bottom, left, right = bounds[0], bounds[1], bounds[2], bounds[3]
    for i in rows:
        r = radius[i]
        for j in range(points.shape[0]):
            a, b = points[j, 0], points[j, 1]
            x = centre[i, 0] + r * (a * u[i, 0] + b * v[i, 0]) + origin[0]
            y = centre[i, 1] + r * (a * u[i, 1] + b * v[i, 1]) + origin[1]
            z = centre[i, 2] + r * (a * u[i, 2] + b * v[i, 2]) + origin[2]
            row, column, _ = cell_of(eye, around, scale, width, height, x, y, z)
            if row >= 0:
                top, bottom = min(top, row), max(bottom, row + 1)
                left, right = min(left, column), max(right, column + 1)
    bounds[0], bounds[1], bounds[2], bounds[3] = top, bottom, left, right


@kernel(error_model="numpy")
def _look_up(
    foreign,
    rows,
    centre,
    u,
    v,
    points,
    radius,
    normal,
    foreign_radii,
    eye,
    around,
    scale,
    origin,
    shape,
    known,
    top,
    left,
):
    """Mark the points of discs whose nearest point lies further than `foreign_radii` of theirs from the disc's
    plane."""
    height, width = shape
    for k in range(rows.shape[0]):
        i = rows[k]
        r = radius[i]
        for j in range(points.shape[0]):
            a, b = points[j, 0], points[j, 1]
            x = centre[i, 0] + r * (a * u[i, 0] + b * v[i, 0]) + origin[0]
            y = centre[i, 1] + r * (a * u[i, 1] + b * v[i, 1]) + origin[1]
            z = centre[i, 2] + r * (a * u[i, 2] + b * v[i, 2]) + origin[2]
            row, column, _ = cell_of(eye, around, scale, width, height, x, y, z)
            if row >= 0:
                at, to = row - top, column - left
                off = (known[at, to, 0] - centre[i, 0]) * normal[i, 0]
                off += (known[at, to, 1] - centre[i, 1]) * normal[i, 1]
                off += (known[at, to, 2] - centre[i, 2]) * normal[i, 2]
                foreign[k, j] = abs(off) > foreign_radii * r
