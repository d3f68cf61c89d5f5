"""Scan (reader) -> zarr: points in slices of the file, photographs decoded once."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.numerics.limits import check_bounds
from pipeline.readers import open_scan
from pipeline.readers.attributes.counts import PointCounts
from pipeline.readers.attributes.looks import Looks
from pipeline.readers.attributes.options import ReadOptions
from pipeline.readers.files.spelling import by_name
from pipeline.scan import Piece, ScanSource
from pipeline.splats.cameras import N_CANDIDATES, rank_candidates
from pipeline.summaries import ScanRead
from storage.errors import InternalError, InvalidScan
from storage.work import arrays

PIECE = 1 << 16  # points a piece: 5 MB with everything that a point may carry
SLICE = 1 << 18  # points a task
MOST_SLICES = 1 << 13  # a larger scan has larger slices: files stay few
SAMPLE = 1 << 18  # points of the sample, of the whole scan; at least LEAST_SAMPLE of each slice
LEAST_SAMPLE = 64
PHOTO_TILE = 512


@dataclass(frozen=True)
class SlicesRead:
    """What there is to know of slices: what `PointCounts` and `Looks` have seen, as their texts; and what black and
    white stand for, the widest 1 % and 99 % of any slice's intensities, None where no point has one that is finite."""

    n_splats: int
    counts: list
    looks: str
    intensity_range: tuple[float, float] | None


@dataclass(frozen=True)
class Ingest:
    """Task i stores slice i of the points, the tasks after them decode a photograph each. Of a file that can be read
    from its start only, one task stores all slices. A row of the arrays is a point of the file, so that no task needs
    to know of others; what is left out has no finite position. Where all points say otherwise of the scan than those
    that were sampled, the summary's `seen` says what, and the stage is to be run again with it.

    Arrays: position (n, 3) float64 absolute; where the scan has them normal (n, 3) float32, color (n, 3) uint8,
    intensity (n,) float32, station (n,) int32, candidate (n, N_CANDIDATES) uint16; photo_<i> (h, w, 3) uint8;
    sample (m, 3) float64: positions evenly spaced in the file, NaN where a slice has fewer.
    """

    scan_path: str
    fingerprint: str  # changes when the scan's files do
    reading: ReadOptions = ReadOptions()
    seen: str = ""  # what all points look like, as Looks.to_text, where they were read before and are not as sampled
    name = "ingest"
    location_fields = ("scan_path",)

    def init(self, folder: Path) -> int:
        source = self._source()
        rows = slice_rows(source)
        for name, dtype in _columns_of(source).items():
            arrays.create(folder, name, (source.n_points, *dtype.shape), str(dtype.base), (rows, *dtype.shape))
        n_sampled = _sampled_rows(source)
        arrays.create(folder, "sample", (_n_slices(source) * n_sampled, 3), "float64", (n_sampled, 3))
        for i, camera in enumerate(source.cameras):
            shape = (camera.height_px, camera.width_px, 3)
            arrays.create(folder, f"photo_{i}", shape, "uint8", (PHOTO_TILE, PHOTO_TILE, 3))
        return _n_point_tasks(source) + len(source.cameras)

    def run(self, folder: Path, index: int) -> SlicesRead | None:
        source = self._source()
        if index >= (n := _n_point_tasks(source)):
            arrays.write_picture(folder, f"photo_{index - n}", source.read_photo(index - n))
            return None
        if source.read_slice is None:
            slices = _regrouped(source.pieces(PIECE), _slice_ends(source))
        else:
            first, stop = arrays.block_range(index, source.n_points, slice_rows(source))
            slices = iter([list(source.read_slice(first, stop, PIECE))])
        return _merged([_store_slice(source, folder, index + i, pieces) for i, pieces in enumerate(slices)])

    def finalise(self, folder: Path, results: list[SlicesRead | None]) -> ScanRead:
        source = self._source()
        points = _merged(results[: _n_point_tasks(source)])
        counts, looks = PointCounts.from_json(points.counts), Looks.from_text(points.looks)
        n_kept, n_read = counts.n_kept, counts.n_points
        if n_read != source.n_points:
            raise InvalidScan(source.path, f"{n_read} points read", f"{source.n_points}, as its header promises")
        if not n_kept:
            found = f"none of its {n_read} points is left: {counts.left_out}"
            raise InvalidScan(source.path, found, "at least one point", "keep points with --marked-points NAME=keep")
        check_bounds(source.path, counts.low, counts.high)
        otherwise = source.settle is not None and looks.parts and source.settle(looks) is not None
        return ScanRead(
            format=source.format,
            unit=source.unit,
            n_points=n_kept,
            n_read=n_read,
            n_dropped=n_read - n_kept,
            low=tuple(counts.low.tolist()),
            high=tuple(counts.high.tolist()),
            intensity_range=points.intensity_range,
            cameras=tuple(source.cameras),
            stations=tuple(source.stations),
            has_visibility=source.has_visibility,
            has_colors=source.has_colors or source.has_intensity,
            warnings=tuple(by_name(text, self.scan_path) for text in (*source.warnings, *counts.warnings(source))),
            unused=tuple(source.unused),
            seen=points.looks if otherwise else "",
            is_albedo=not (source.has_colors or source.has_intensity or source.cameras),
        )

    def _source(self) -> ScanSource:
        return _opened(self.scan_path, self.fingerprint, self.reading, self.seen)


@functools.lru_cache(maxsize=2)
def _opened(scan_path: str, fingerprint: str, reading: ReadOptions, seen: str) -> ScanSource:
    source = open_scan(scan_path, reading)
    return (source.settle(Looks.from_text(seen)) or source) if seen and source.settle else source


def slice_rows(source: ScanSource) -> int:
    """Points a slice: the same however many workers there are, and whole runs of what the reader decodes at once."""
    wanted = max(SLICE, -(-source.n_points // MOST_SLICES))
    return max(1, round(wanted / source.slice_rows)) * source.slice_rows


def _n_slices(source: ScanSource) -> int:
    return arrays.n_blocks(source.n_points, slice_rows(source))


def _n_point_tasks(source: ScanSource) -> int:
    return 1 if source.read_slice is None else _n_slices(source)


def _sampled_rows(source: ScanSource) -> int:
    return min(slice_rows(source), max(LEAST_SAMPLE, SAMPLE // _n_slices(source)))


def _columns_of(source: ScanSource) -> dict[str, np.dtype]:
    has = {
        "normal": source.has_normals,
        "color": source.has_colors,
        "intensity": source.has_intensity,
        "station": bool(source.stations),
        "candidate": source.has_visibility,
    }
    kinds = {
        "position": ("f4" if source.is_single else "f8", (3,)),  # readers of it subtract the origin in float64
        "normal": ("f4", (3,)),
        "color": ("u1", (3,)),
        "intensity": ("f4", ()),
        "station": ("i4", ()),
        "candidate": ("u2", (N_CANDIDATES,)),
    }
    return {name: np.dtype(kind) for name, kind in kinds.items() if has.get(name, True)}


def _slice_ends(source: ScanSource) -> Iterator[int]:
    return (
        min(source.n_points, stop)
        for stop in range(slice_rows(source), source.n_points + slice_rows(source), slice_rows(source))
    )


def _regrouped(pieces: Iterator[Piece], ends: Iterator[int]) -> Iterator[list[Piece]]:
    """The pieces up to each end, cut where they cross one."""
    held, at, end = [], 0, next(ends)  # type: ignore[var-annotated]
    for piece in pieces:
        while at + len(piece.position) >= end:
            first, piece = _cut(piece, end - at)
            yield [*held, first]
            held, at, end = [], end, next(ends, np.inf)  # type: ignore[assignment]
        at += len(piece.position)
        held.append(piece)


def _cut(piece: Piece, n: int) -> tuple[Piece, Piece]:
    """The first n points of a piece, and the others; what was seen of all of them goes with the first, to count
    once."""
    n_seen = 0 if piece.visible_count is None else int(piece.visible_count[:n].sum())
    columns = {
        name: (value, n_seen if name == "visible_camera" else n)
        for name, value in vars(piece).items()
        if value is not None and name != "look"
    }
    first, others = ({k: v[cut(m)] for k, (v, m) in columns.items()} for cut in (slice, lambda m: slice(m, None)))
    return Piece(**first, look=piece.look), Piece(**others)


def _store_slice(source: ScanSource, folder: Path, index: int, pieces: list[Piece]) -> SlicesRead:
    """Write the points of slice `index`; what there is to know of them."""
    start, stop = arrays.block_range(index, source.n_points, slice_rows(source))
    rows = {name: np.empty((stop - start, *dtype.shape), dtype.base) for name, dtype in _columns_of(source).items()}
    at, counts, looks = 0, PointCounts(), Looks()
    for piece in pieces:
        end, columns = at + len(piece.position), _columns(piece, source)
        if columns.keys() != rows.keys():
            raise InvalidScan(
                source.path,
                f"only some of the points have {', '.join(sorted(columns.keys() ^ rows.keys()))}",
                "all points or none",
            )
        for name, values in columns.items():
            rows[name][at:end] = values
        if source.is_single and not np.array_equal(rows["position"][at:end], piece.position, equal_nan=True):
            raise InternalError(source.path, "coordinates that are no float32", "float32, as its reader says")
        rows["position"][at:end][~counts.add(piece)] = np.nan
        looks.add(piece.look)
        at = end
    assert at == stop - start, (at, start, stop)
    finite = np.isfinite(rows["position"]).all(axis=1)
    for name, values in rows.items():
        arrays.write(folder, name, start, values)
    position = rows["position"] if finite.all() else rows["position"][finite]
    _store_sample(source, folder, index, position)
    intensity = rows["intensity"][finite].astype(np.float64) if "intensity" in rows else np.empty(0)
    known = intensity[np.isfinite(intensity)]
    low_to_high = tuple(np.quantile(known, (0.01, 0.99)).tolist()) if len(known) else None
    return SlicesRead(int(finite.sum()), counts.to_json(), looks.to_text(), low_to_high)


def _store_sample(source: ScanSource, folder: Path, index: int, position: np.ndarray) -> None:
    n = _sampled_rows(source)
    chosen = np.full((n, 3), np.nan)
    rows = np.arange(min(n, len(position))) * max(1, len(position) // n)
    chosen[: len(rows)] = position[rows]
    arrays.write(folder, "sample", index * n, chosen)


def _columns(piece: Piece, source: ScanSource) -> dict[str, np.ndarray]:
    """The rows of a piece by array name."""
    columns = {
        "position": piece.position,
        "normal": piece.normal,
        "color": piece.color,
        "intensity": piece.intensity,
        "station": piece.station,
    }
    columns = {name: rows for name, rows in columns.items() if rows is not None}
    if piece.visible_count is not None:
        columns["candidate"] = rank_candidates(
            piece.position, piece.normal, piece.visible_count, piece.visible_camera, source.cameras
        )
    return columns


def _merged(slices: list[SlicesRead]) -> SlicesRead:
    """What there is to know of several slices."""
    ranges = [s.intensity_range for s in slices if s.intensity_range is not None]
    counts, looks = PointCounts(), Looks()
    for s in slices:
        counts.merge(PointCounts.from_json(s.counts))
        looks.merge(Looks.from_text(s.looks))
    widest = (min(low for low, _ in ranges), max(high for _, high in ranges)) if ranges else None
    return SlicesRead(counts.n_kept, counts.to_json(), looks.to_text(), widest)
