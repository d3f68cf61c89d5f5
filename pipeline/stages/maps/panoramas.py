"""Points -> a map of each station: what it saw all around, drawn from the splats of all its points."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.cameras.polar_capped import COLUMNS, height_for
from pipeline.maps.draw import NARROWEST, WIDEST, draw_color, draw_depth, empty_canvas, finish
from pipeline.maps.station_map import MapFrame, StationMap
from pipeline.splats.colors import point_colors
from pipeline.splats.normals import turned_to
from pipeline.splats.sizes import needed_sizes
from pipeline.summaries import MapsDrawn, Points, ScanRead
from storage.maps import MAP_ROWS
from storage.work import arrays, work

# Of a station's spacings, in radians: that of surfaces that face it. Slanted ones, and thin ones, have wider ones.
STEP_QUANTILE = 0.25
BINS_AN_OCTAVE, OCTAVES = 64, 40  # of the histogram that it is read from, down from one radian
MOST_TEXELS = 1 << 25  # of a map, 24 bytes each while it is drawn; steps down to 0.038 degrees
HIGHEST = int((MOST_TEXELS / COLUMNS) ** 0.5) // MAP_ROWS * MAP_ROWS


@dataclass(frozen=True)
class StationDrawn:
    """What a task tells of its station; no frame where it saw nothing."""

    frame: MapFrame | None
    n_splats: int
    n_left_out: int
    height_wanted: int
    covered: float = 0.0


@dataclass(frozen=True)
class Panoramas:
    """A task a station; it streams all points three times, and draws those that the station saw. Arrays: color_<i>
    (h, 6 h, 4) uint8 and depth_<i> (h, 6 h) uint16, as `StationMap`. The summary has each one's `MapFrame`, or None for
    a station that saw nothing."""

    ingest: Path
    partition: Path  # of all points
    neighbours: Path  # of that
    name = "panoramas"

    def init(self, folder: Path) -> int:
        return len(work.summary(self.ingest, ScanRead).stations)

    def run(self, folder: Path, index: int) -> StationDrawn:
        station = _Station(self, index)
        wanted, n_points = station.step_and_count()
        if wanted is None:
            return StationDrawn(frame=None, n_splats=0, n_left_out=n_points, height_wanted=0)
        height = min(-(-height_for(wanted) // MAP_ROWS) * MAP_ROWS, HIGHEST)
        canvas = empty_canvas(height)
        n_left_out = sum(draw_depth(canvas, *splats[:3]) for splats in station.splats(height))
        for splats in station.splats(height):
            draw_color(canvas, *splats)
        made = finish(canvas, index, tuple(station.centre.tolist()))
        arrays.store(folder, f"color_{index}", made.color, made.color.shape)
        arrays.store(folder, f"depth_{index}", made.depth, made.depth.shape)
        return StationDrawn(
            frame=made.frame,
            n_splats=n_points,
            n_left_out=n_left_out,
            height_wanted=height_for(wanted),
            covered=float((made.color[..., 3] > 0).mean()),
        )

    def finalise(self, folder: Path, results: list[StationDrawn]) -> MapsDrawn:
        return MapsDrawn(
            frames=tuple(r.frame for r in results),
            n_left_out=sum(r.n_left_out for r in results),
            height_wanted=tuple(r.height_wanted for r in results),
        )


def read_map(folder: Path, index: int) -> StationMap | None:
    """The map of a station, from a folder as that of `Panoramas`; its pictures are read where they are looked at."""
    frame = work.summary(folder, MapsDrawn).frames[index]
    if frame is None:
        return None
    color, depth = (arrays.mapped(folder, f"{name}_{index}") for name in ("color", "depth"))
    return StationMap(frame, np.asarray(color), np.asarray(depth))


@dataclass(frozen=True)
class _Station:
    """The points that one station saw, a block at a time."""

    sources: Panoramas
    index: int

    @property
    def centre(self) -> np.ndarray:
        return np.array(work.summary(self.sources.ingest, ScanRead).stations[self.index], np.float64)

    def step_and_count(self) -> tuple[float | None, int]:
        """The angle between neighbouring samples, in radians (None where that cannot be told), and their number."""
        counts, n_points = np.zeros(BINS_AN_OCTAVE * OCTAVES, np.int64), 0
        for _, local, spacing in self._blocks():
            distance = np.linalg.norm(local, axis=1)
            n_points += len(distance)
            known = np.isfinite(spacing) & (spacing > 0) & (distance > spacing)
            octave = -np.log2(spacing[known] / distance[known])
            counts += np.histogram(np.clip(octave, 0, OCTAVES - 1e-9), len(counts), (0, OCTAVES))[0]
        if not counts.sum():
            return None, n_points
        wider = np.cumsum(counts) / counts.sum()  # the share of spacings that are as wide as a bin's, or wider
        return float(2.0 ** -((np.searchsorted(wider, 1 - STEP_QUANTILE) + 0.5) / BINS_AN_OCTAVE)), n_points

    def splats(self, height: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
        """Position against the station, normal, radius and colour of its points, for a map of this height."""
        step = np.pi / 2 / height
        scan, s = work.summary(self.sources.ingest, ScanRead), self.sources
        for (start, stop, rows), local, spacing in self._blocks():
            normal = arrays.read(s.neighbours, "normal", start, stop)[rows].astype(np.float64)
            distance = np.linalg.norm(local, axis=1)
            size = needed_sizes(local, spacing, 0.0)
            radius = np.clip(size, NARROWEST * step * distance, WIDEST * step * distance)
            turned = np.zeros((stop - start, 3))
            turned[rows] = turned_to(normal, -local)
            yield local, normal, radius, point_colors(scan, s.partition, turned, start, stop)[rows]

    def _blocks(self) -> Iterator[tuple[tuple[int, int, np.ndarray], np.ndarray, np.ndarray]]:
        """Of each block that has points of the station: its range and which of its points they are, their positions
        against the station, and their spacings."""
        points, s = work.summary(self.sources.partition, Points), self.sources
        offset = np.array(points.origin) - self.centre
        for block in range(arrays.n_blocks(points.n_splats)):
            start, stop = arrays.block_range(block, points.n_splats)
            rows = np.arange(stop - start)
            if arrays.exists(s.partition, "station"):
                rows = np.flatnonzero(arrays.read(s.partition, "station", start, stop) == self.index)
            if len(rows):
                local = arrays.read(s.partition, "position", start, stop)[rows] + offset
                yield (start, stop, rows), local, arrays.read(s.neighbours, "spacing", start, stop)[rows].astype(float)
