"""What is wrong with a scan, from its header and one pass over its points: what the ingest would drop or refuse."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.numerics.limits import SMALLEST_RADIUS, check_bounds
from pipeline.readers.detect import open_scan
from pipeline.scan import Piece, ScanSource
from storage.errors import InvalidScan

PIECE = 1 << 16
TOO_FEW = 4  # different positions: the splat radius is the distance to the fourth neighbour
# Points further from zero than so many extents lose digits in float32 that they keep against their own middle.
FAR_IN_EXTENTS = 1.0


@dataclass(frozen=True)
class Finding:
    """One line: an error stops `compress`, a warning is met by what it says, a note is worth knowing."""

    severity: str  # "error" | "warning" | "note"
    text: str


@dataclass
class _Counts:
    n_points: int = 0
    n_finite: int = 0
    n_without_normal: int = 0
    n_without_intensity: int = 0
    n_without_color: int = 0
    n_unseen: int = 0
    different: np.ndarray | None = None  # (m, 3) positions, no more of them than tell that a radius can be had
    low: np.ndarray | float = np.inf
    high: np.ndarray | float = -np.inf

    def add(self, piece: Piece) -> None:
        finite = np.isfinite(piece.position).all(axis=1)
        self.n_points += len(finite)
        self.n_finite += int(finite.sum())
        if finite.any():
            self.low = np.minimum(self.low, piece.position[finite].min(axis=0))
            self.high = np.maximum(self.high, piece.position[finite].max(axis=0))
            if self.different is None or len(self.different) <= TOO_FEW:
                known = (
                    piece.position[finite]
                    if self.different is None
                    else np.concatenate([self.different, piece.position[finite]])
                )
                self.different = np.unique(known, axis=0)[: TOO_FEW + 1]
        if piece.normal is not None:
            length = np.abs(piece.normal[finite].astype(np.float64)).sum(axis=1)
            self.n_without_normal += int((~np.isfinite(length) | (length == 0)).sum())
        if piece.intensity is not None:
            self.n_without_intensity += int((~np.isfinite(piece.intensity[finite])).sum())
        if piece.colorless is not None:
            self.n_without_color += int(piece.colorless[finite].sum())
        if piece.visible_count is not None:
            self.n_unseen += int((piece.visible_count[finite] == 0).sum())


def black_points(source: ScanSource, n: int, n_color: int, n_intensity: int) -> list[str]:
    """Warnings of colours and intensities that are not finite, of n points that have a position."""
    found = []
    if n_color:
        found.append(f"{n_color} of {n} points have a colour that is not finite and are drawn black")
    if n_intensity == n and not source.has_colors:
        found.append("no point has an intensity that is finite; splats are grey, shaded by their normals")
    elif n_intensity and not source.has_colors:
        found.append(f"{n_intensity} of {n} points have an intensity that is not finite and are drawn black")
    return found


def check_scan(path: str) -> list[Finding]:
    """All findings, errors first. Photographs are not decoded.

    Raises: FileNotFoundError and UnsupportedScan as `open_scan`; what breaks a format is a finding.
    """
    try:
        source = open_scan(path)
        counts = _Counts()
        for piece in source.pieces(PIECE):
            counts.add(piece)
        found = list(_findings(source, counts))
    except InvalidScan as error:
        return [Finding("error", str(error))]
    return sorted(found, key=lambda f: ("error", "warning", "note").index(f.severity))


def _findings(source: ScanSource, counts: _Counts) -> Iterator[Finding]:
    for warning in source.warnings:
        yield Finding("warning", warning)
    n = counts.n_points
    if not counts.n_finite:
        yield Finding(
            "error", f"{source.path}: none of its {n} points has a finite position; allowed: at least one point"
        )
        return
    try:
        check_bounds(source.path, counts.low, counts.high)
    except InvalidScan as error:
        yield Finding("error", str(error))
    if counts.n_finite < n:
        yield Finding(
            "warning", f"{n - counts.n_finite} of {n} points have a position that is not finite and are dropped"
        )
    if counts.n_without_normal:
        yield Finding(
            "warning",
            f"{counts.n_without_normal} of {n} points have a normal that is zero or not finite; their neighbours tell it",
        )
    for warning in black_points(source, counts.n_finite, counts.n_without_color, counts.n_without_intensity):
        yield Finding("warning", warning)
    if source.has_visibility and counts.n_unseen:
        yield Finding("note", f"{counts.n_unseen} of {n} points are seen by no camera and keep the scan's colour")
    yield from _notes_on_extent(counts)


def _notes_on_extent(counts: _Counts) -> Iterator[Finding]:
    extent = counts.high - counts.low
    if len(counts.different) <= TOO_FEW:
        n = len(counts.different)
        what = "all points are one position" if n == 1 else f"the points have {n} different positions"
        yield Finding("warning", f"{what}: a splat radius cannot be told, give one with --radius")
        if n == 1:
            return
    elif extent.max() < SMALLEST_RADIUS:
        span = f"the points span {extent.max():g}"
        yield Finding("warning", f"{span}, less than the smallest splat radius of {SMALLEST_RADIUS:g}: scale the scan")
    away = np.abs((counts.low + counts.high) / 2).max()
    if away > FAR_IN_EXTENTS * extent.max():
        yield Finding(
            "note",
            f"the points lie {away:g} from zero and span {extent.max():g}; positions are kept against their middle",
        )
