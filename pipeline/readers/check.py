"""What is wrong with a scan, from its header and one pass over its points: what the ingest would leave out or refuse."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.numerics.limits import SMALLEST_RADIUS, check_bounds
from pipeline.readers.attributes.counts import PointCounts, over_all_points
from pipeline.readers.attributes.looks import Looks
from pipeline.readers.attributes.options import ReadOptions
from pipeline.readers.detect import open_scan
from pipeline.readers.inspect import lacks
from pipeline.scan import ScanSource
from storage.errors import InvalidScan, ResourceExhausted

PIECE = 1 << 16
TOO_FEW = 4  # different positions: the splat radius is the distance to the fourth neighbour
# Points further from zero than so many extents lose digits in float32 that they keep against their own middle.
FAR_IN_EXTENTS = 1.0


@dataclass(frozen=True)
class Finding:
    """One line: an error stops `compress`, a warning is met by what it says, a note is worth knowing."""

    severity: str  # "error" | "warning" | "note"
    text: str


@dataclass(frozen=True)
class _Seen:
    counts: PointCounts
    different: np.ndarray  # (m, 3) positions, no more of them than tell that a radius can be had


def _pass_over(source: ScanSource, looks: Looks) -> _Seen:
    counts, different = PointCounts(), np.zeros((0, 3))
    for piece in source.pieces(PIECE):
        looks.add(piece.look)
        keep = counts.add(piece)
        if keep.any() and len(different) <= TOO_FEW:
            known = np.concatenate([different, piece.position[keep]])
            different = np.unique(known, axis=0)[: TOO_FEW + 1]
    return _Seen(counts, different)


def check_scan(path: str, options: ReadOptions = ReadOptions()) -> list[Finding]:
    """All findings, errors first. Photographs are not decoded.

    Raises: FileNotFoundError and UnsupportedScan as `open_scan`; what breaks a format is a finding.
    """
    try:
        source, seen = over_all_points(open_scan(path, options), _pass_over)
        found = list(_findings(source, seen))
    except (InvalidScan, ResourceExhausted) as error:
        return [Finding("error", str(error))]
    return sorted(found, key=lambda f: ("error", "warning", "note").index(f.severity))


def _findings(source: ScanSource, seen: _Seen) -> Iterator[Finding]:
    counts = seen.counts
    for warning in source.warnings:
        yield Finding("warning", warning)
    n = counts.n_points
    if not counts.n_kept:
        text = f"{source.path}: none of its {n} points is left: {counts.left_out}; allowed: at least one point"
        yield Finding("error", text)
        return
    try:
        check_bounds(source.path, counts.low, counts.high)
    except InvalidScan as error:
        yield Finding("error", str(error))
    if counts.n_without_normal:
        what = f"{counts.n_without_normal} of {n} points have a normal that is zero or not finite"
        yield Finding("warning", f"{what}; their neighbours tell it")
    for warning in counts.warnings(source):
        yield Finding("warning", warning)
    if source.has_visibility and counts.n_unseen:
        yield Finding("note", f"{counts.n_unseen} of {n} points are seen by no camera and keep the scan's colour")
    low, high = (", ".join(f"{x:.6g}" for x in corner) for corner in (counts.low, counts.high))
    unit = "unit unknown" if source.unit == "unknown" else source.unit
    yield Finding("note", f"{counts.n_kept:,} points from ({low}) to ({high}), {unit}")
    for text in lacks(source):
        yield Finding("note", text)
    if source.unused:
        yield Finding("note", f"properties that are there and not used: {', '.join(source.unused)}")
    yield from _notes_on_extent(seen)


def _notes_on_extent(seen: _Seen) -> Iterator[Finding]:
    low, high = seen.counts.low, seen.counts.high
    extent = high - low
    if len(seen.different) <= TOO_FEW:
        n = len(seen.different)
        what = "all points are one position" if n == 1 else f"the points have {n} different positions"
        yield Finding("warning", f"{what}: a splat radius cannot be told, give one with --radius")
        if n == 1:
            return
    elif extent.max() < SMALLEST_RADIUS:
        span = f"the points span {extent.max():g}"
        yield Finding("warning", f"{span}, less than the smallest splat radius of {SMALLEST_RADIUS:g}: scale the scan")
    away = np.abs((low + high) / 2).max()
    if away > FAR_IN_EXTENTS * extent.max():
        found = f"the points lie {away:g} from zero and span {extent.max():g}"
        yield Finding("note", f"{found}; positions are kept against their middle")
