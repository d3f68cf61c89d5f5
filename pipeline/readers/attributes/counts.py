"""What one pass over a scan's points finds: what is left out and why, said in the same words by `check` and by the ingest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from pipeline.readers.attributes.looks import Looks
from pipeline.readers.attributes.marks import MARKS, tally, warnings_of
from pipeline.scan import Piece, ScanSource

# Steps of coordinates above this share of the spacing of points move points by an eighth of it and more.
COARSE_SHARE = 0.25
FAR_INSIDE = 0.5  # of what points span: bounds of a file that was cut are wider than its points
FAR_SPANS = 1000.0  # a site of 100 m is 0.001 degrees, with heights of metres

T = TypeVar("T")


def over_all_points(source: ScanSource, pass_over: Callable[[ScanSource, Looks], T]) -> tuple[ScanSource, T]:
    """What `pass_over` makes of all points of a scan, and the scan as all of its points have it.

    `pass_over` adds what its pieces look like to the looks it is given; where they say otherwise than those that were
    sampled, it is called once more.
    """
    looks = Looks()
    found = pass_over(source, looks)
    settled = source.settle(looks) if source.settle and looks.parts else None
    return (source, found) if settled is None else (settled, pass_over(settled, Looks()))


_SUMS = (
    "n_points",
    "n_kept",
    "n_not_finite",
    "n_without_normal",
    "n_without_intensity",
    "n_without_color",
    "n_unseen",
    "n_at_origin",
    "marked",
)


@dataclass
class PointCounts:
    """Sums over the pieces of a scan; `add` returns which points are drawn."""

    n_points: int = 0
    n_kept: int = 0
    n_not_finite: int = 0
    n_without_normal: int = 0
    n_without_intensity: int = 0
    n_without_color: int = 0
    n_unseen: int = 0
    n_at_origin: int = 0
    marked: np.ndarray = field(default_factory=lambda: np.zeros(len(MARKS) + 1, np.int64))
    low: np.ndarray = field(default_factory=lambda: np.full(3, np.inf))
    high: np.ndarray = field(default_factory=lambda: np.full(3, -np.inf))

    def add(self, piece: Piece) -> np.ndarray:  # (n,) bool
        finite = np.isfinite(piece.position).all(axis=1)
        unmarked = np.ones(len(finite), bool) if piece.mark is None else piece.mark == 0
        keep = finite & unmarked
        self.n_points += len(keep)
        self.n_kept += int(np.count_nonzero(keep))
        self.n_not_finite += int(np.count_nonzero(unmarked & ~finite))
        if piece.mark is not None:
            self.marked += tally(piece.mark)
        if keep.any():
            kept = piece.position if keep.all() else piece.position[keep]
            self.low = np.minimum(self.low, kept.min(axis=0))
            self.high = np.maximum(self.high, kept.max(axis=0))
            if (there := kept[:, 0] == 0).any():
                self.n_at_origin += int(np.count_nonzero(there & (kept[:, 1] == 0) & (kept[:, 2] == 0)))
        self._add_attributes(piece, keep)
        return keep

    def merge(self, other: PointCounts) -> None:
        for name in _SUMS:
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.low, self.high = np.minimum(self.low, other.low), np.maximum(self.high, other.high)

    def to_json(self) -> list:
        has = self.n_kept > 0
        corners = [self.low.tolist(), self.high.tolist()] if has else None
        return [*(getattr(self, name) for name in _SUMS[:-1]), self.marked.tolist(), corners]

    @staticmethod
    def from_json(data: list) -> PointCounts:
        made = PointCounts(**dict(zip(_SUMS[:-1], data[:-2], strict=True)))
        made.marked = np.array(data[-2], np.int64)
        if data[-1] is not None:
            made.low, made.high = map(np.array, data[-1])
        return made

    def _add_attributes(self, piece: Piece, keep: np.ndarray) -> None:
        if piece.normal is not None:
            length = np.abs(piece.normal[keep]).sum(axis=1, dtype=np.float64)
            self.n_without_normal += int((~np.isfinite(length) | (length == 0)).sum())
        if piece.intensity is not None:
            self.n_without_intensity += int((~np.isfinite(piece.intensity[keep])).sum())
        if piece.colorless is not None:
            self.n_without_color += int(piece.colorless[keep].sum())
        if piece.visible_count is not None:
            self.n_unseen += int((piece.visible_count[keep] == 0).sum())

    @property
    def left_out(self) -> str:
        """Why there is no point left, for an error."""
        reasons = [f"{n:,} {mark.text}" for mark, n in zip(MARKS, self.marked[1:], strict=True) if n]
        if self.n_not_finite:
            reasons.append(f"{self.n_not_finite:,} have a position that is not finite")
        return "; ".join(reasons) or "there is none"

    def warnings(self, source: ScanSource) -> list[str]:
        """All that is left out, or drawn otherwise than measured."""
        found = warnings_of(self.marked, self.n_points)
        if self.n_not_finite:
            found.append(
                f"{self.n_not_finite} of {self.n_points} points have a position that is not finite and are dropped"
            )
        if self.n_at_origin > 1:
            found.append(
                f"{self.n_at_origin:,} of {self.n_points:,} points lie at (0, 0, 0), as what was not measured does in "
                "depth pictures, and are kept"
            )
        found += black_points(source, self.n_kept, self.n_without_color, self.n_without_intensity)
        return found + self.wrong_bounds(source) + self.coarse_steps(source) + self.likely_degrees(source)

    def wrong_bounds(self, source: ScanSource) -> list[str]:
        """A warning where points lie outside of the bounds that a LAS header declares, or all of them far inside."""
        if source.format != "las" or source.bounds is None or not self.n_kept:
            return []
        low, high = map(np.array, source.bounds)
        step = source.position_step or 0.0
        outside = max(float((low - self.low).max()), float((self.high - high).max()))
        inside = max(float((self.low - low).max()), float((high - self.high).max()))
        is_whole = self.n_kept == self.n_points  # what is left out may have been at the bounds
        if outside <= step and (inside <= FAR_INSIDE * float((self.high - self.low).max()) + step or not is_whole):
            return []
        said, found = (
            " to ".join(f"({', '.join(f'{x:.6g}' for x in corner)})" for corner in corners)
            for corners in (source.bounds, (self.low, self.high))
        )
        return [f"the header has points lie from {said}, but they lie from {found}: its bounds are wrong and not used"]

    def coarse_steps(self, source: ScanSource) -> list[str]:
        """A warning where coordinates are kept in steps that are not small against the spacing of points."""
        if self.n_kept < 2:
            return []
        away = float(np.abs([self.low, self.high]).max())
        step = source.position_step
        if step is None:
            step = float(np.spacing(np.float32(min(away, 3e38)))) if source.position_type == "float32" else 0.0
        extent = np.sort(self.high - self.low)[::-1]
        # Of a surface; of points on a line its length divided by their number is more.
        spacing = float(max(np.sqrt(extent[0] * extent[1] / self.n_kept), extent[0] / self.n_kept))
        if step <= COARSE_SHARE * spacing:
            return []
        kept = f"as {source.position_type}" if source.position_step is None else "in whole steps"
        return [
            f"positions are kept {kept} and reach {away:g}, where they differ by {step:.3g} at least, "
            f"but points lie about {spacing:.3g} apart: detail is lost; export with an offset or as float64"
        ]

    def likely_degrees(self, source: ScanSource) -> list[str]:
        """A warning where x and y of a scan without a unit look like longitudes and latitudes: within their range, far from zero
        for what they span, and spanning next to nothing beside z."""
        if source.unit != "unknown" or self.n_kept < 2:
            return []
        extent, away = self.high - self.low, np.maximum(np.abs(self.low), np.abs(self.high))
        across = float(extent[:2].max())
        is_within = away[0] <= 180 and away[1] <= 90 and bool((away[:2] >= FAR_SPANS * extent[:2]).all())
        if not is_within or not 0 < across * FAR_SPANS < extent[2]:
            return []
        return [
            f"x and y span {across:.3g} about ({self.low[0]:.6g}, {self.low[1]:.6g}) where z spans {extent[2]:.3g}: they may be "
            "degrees; turn them into a projected system first"
        ]


def black_points(source: ScanSource, n: int, n_color: int, n_intensity: int) -> list[str]:
    """Warnings of colours and intensities that are not finite, of n points that have a position."""
    found = []
    if n_color:
        found.append(f"{n_color} of {n} points have a colour that is not finite and are drawn black")
    if n_intensity == n and not source.has_colors and n:
        found.append("no point has an intensity that is finite; splats are grey, shaded by their normals")
    elif n_intensity and not source.has_colors:
        found.append(f"{n_intensity} of {n} points have an intensity that is not finite and are drawn black")
    return found
