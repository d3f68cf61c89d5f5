"""E57 through libe57: several stations with their poses, read in pieces through buffers of fixed size.

Cartesian or spherical coordinates. What a scanner did not measure is marked: an invalid state, or a point at the scanner's
own origin, which some scanners write for what they did not hit. Positions are float64, in metres by the standard.

References: ASTM E2807-11, section 8.4.2; pye57#45 (reading in pieces).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from pye57 import libe57

from pipeline.readers.attributes.decisions import Decision, reasons
from pipeline.readers.attributes.looks import Look, Looks
from pipeline.readers.attributes.marks import set_marks
from pipeline.readers.attributes.options import ReadOptions
from pipeline.readers.attributes.ranges import range_of
from pipeline.readers.e57.damage import reason_of
from pipeline.readers.e57.images import Images, read_images, read_photo
from pipeline.readers.e57.kept import state_of, take
from pipeline.readers.e57.nodes import open_image_file
from pipeline.readers.e57.packets import BitField, bit_fields, packets_of, read_points
from pipeline.readers.e57.points import (
    Rows,
    color_of,
    cut,
    decide_station,
    first_looks,
    local_of,
    look_at,
    masks_of,
    names_of,
    station_rows,
    usual_top,
)
from pipeline.readers.e57.stations import (
    INTENSITY,
    Station,
    read_station,
)
from pipeline.scan import Piece, ScanSource
from storage.errors import InvalidScan, SplatpressError

GREY = 128  # of a station that has no colours while others do


@dataclass(frozen=True)
class _Opened:
    """All that an E57's source is made of; `looks` by station."""

    path: str
    options: ReadOptions
    stations: tuple[Station, ...]
    images: Images
    looks: tuple[Look, ...]
    fields: tuple[tuple[BitField, ...] | None, ...]  # of all scans of the file, empty ones too
    warnings: tuple[str, ...]

    @property
    def n_fields(self) -> tuple[int, ...]:
        """Of each scan that is read; 0 for those that are left out."""
        read = {s.index for s in self.stations}
        return tuple(len(f) if f is not None and i in read else 0 for i, f in enumerate(self.fields))

    @property
    def is_sample(self) -> bool:
        return any(look.n_points < s.n_points for look, s in zip(self.looks, self.stations, strict=True))

    @cached_property
    def decisions(self) -> tuple[Decision, ...]:
        return tuple(decide_station(s, look) for s, look in zip(self.stations, self.looks, strict=True))

    @property
    def has_colors(self) -> bool:
        return any(d.top is not None for d in self.decisions)

    @property
    def has_intensity(self) -> bool:
        """Whether points have one that can be used: all of them, or some where nothing else tells how they look."""
        usable = [d.intensity for d in self.decisions]
        return all(usable) if self.has_colors else any(usable)

    @property
    def n_points(self) -> int:
        return sum(s.n_points for s in self.stations)


# --- points ---


def _pieces(opened: _Opened, max_points: int) -> Iterator[Piece]:
    if max_points < 1:
        raise ValueError(f"max_points {max_points}; allowed: 1 or more")
    if (kept := take(opened.path)) is not None and len(kept) == len(opened.stations):
        for i, columns in enumerate(kept):
            for rows in cut(columns, max_points):
                yield _piece(opened, i, rows)
        return
    with open_image_file(opened.path) as file:
        for i, station in enumerate(opened.stations):
            where = f"{opened.path}:data3D[{station.index}]"
            for rows in station_rows(file, where, station, max_points, True):
                yield _piece(opened, i, rows)


def _slice(opened: _Opened, first: int, stop: int, max_points: int) -> Iterator[Piece]:
    """Points first..stop of all stations in a row, without those before them."""
    packets, before = packets_of(opened.path, opened.n_fields), 0
    for i, station in enumerate(opened.stations):
        for at in range(max(0, first - before), min(station.n_points, stop - before), max_points):
            end = min(at + max_points, station.n_points, stop - before)
            fields = opened.fields[station.index]
            names, where = names_of(station), packets[station.index]
            yield _piece(opened, i, read_points(opened.path, where, fields, names, at, end))
        before += station.n_points


def _piece(opened: _Opened, i: int, rows: Rows) -> Piece:
    station, decision = opened.stations[i], opened.decisions[i]
    local = local_of(rows, station)
    masks, n, look = masks_of(rows, station, local), len(local), None
    if opened.is_sample:
        look = opened.looks[i].like()
        look_at(look, rows, station, masks)
    drawn_by_color = opened.has_colors
    normals = _normals(rows, station, n) if any(s.normal for s in opened.stations) else None
    color, intensity = None, None
    if drawn_by_color:
        color = color_of(rows, station, decision.top) if decision.top is not None else np.full((n, 3), GREY, np.uint8)
    if opened.has_intensity:
        measured = decision.intensity
        intensity = rows[INTENSITY].astype(np.float32) if measured else np.full(n, _middle(opened), np.float32)
    unused = {"no-intensity"} if drawn_by_color or not decision.intensity else {"no-color"}
    unused |= {"no-color"} if decision.top is None else set()
    scanners = [s for s in opened.stations if s.has_scanner]
    at = scanners.index(station) if station.has_scanner else -1
    return Piece(
        position=local if station.pose is None else station.pose.apply(local),
        normal=normals,
        color=color,
        intensity=intensity,
        station=np.full(n, at, np.int32) if scanners else None,
        look=None if look is None else (i, look),
        mark=set_marks(n, masks, opened.options.left_out - unused),
    )


def _normals(rows: Rows, station: Station, n: int) -> np.ndarray:  # (n, 3) float32, zero where there is none
    if not station.normal:
        return np.zeros((n, 3), np.float32)
    normal = np.stack([rows[name] for name in station.normal], axis=1)
    return (normal if station.pose is None else normal @ np.array(station.pose.rotation).T).astype(np.float32)


def _middle(opened: _Opened) -> float:
    """The intensity that a station without one is drawn with."""
    known = [look.intensity.first[0] for look, d in zip(opened.looks, opened.decisions, strict=True) if d.intensity]
    return float(np.median(known))


# --- opening ---


def _read_stations(file: libe57.ImageFile, path: str) -> tuple[list[Station], list[str]]:
    """The stations that can be read, and what is wrong with the others.

    Raises: what the first of them raises, where none can be read.
    """
    scans = file.root()["data3D"] if file.root().isDefined("data3D") else []
    stations, errors = [], []
    for i, scan in enumerate(scans):
        try:
            stations.append(read_station(scan, i, f"{path}:data3D[{i}]"))
        except SplatpressError as error:
            errors.append(error)
        except libe57.E57Exception as error:
            errors.append(InvalidScan(f"{path}:data3D[{i}]", f"unreadable: {reason_of(error)}", "a whole E57 file"))
    if errors and not stations:
        raise errors[0]
    warnings = [f"a station is left out: {error}" for error in errors]
    if empty := [s.name for s in stations if not s.n_points]:
        if len(empty) < len(stations):
            warnings.append(f"{path}: stations {empty} have no points and are left out")
        stations = [s for s in stations if s.n_points]
    return stations, warnings


def _fields_of(file: libe57.ImageFile) -> tuple[tuple[BitField, ...] | None, ...]:
    """How the points of each scan are packed; None for one whose points cannot be read from their middle."""
    scans = file.root()["data3D"] if file.root().isDefined("data3D") else []
    has_points = (scan.isDefined("points") for scan in scans)
    return tuple(
        bit_fields(libe57.StructureNode(scan["points"].prototype())) if has else None
        for scan, has in zip(scans, has_points, strict=True)
    )


def open_e57(path: str, options: ReadOptions = ReadOptions()) -> ScanSource:
    """An E57 file: all its scans one after the other, and its posed images as cameras.

    Guarantees: memory for points is that of one piece; every station's pose is applied in float64.
    Raises: InvalidScan for a file that is truncated or damaged or contradicts itself; UnsupportedScan for points
    without coordinates.
    """
    state = state_of(path)
    with open_image_file(path) as file:
        stations, warnings = _read_stations(file, path)
        fields = _fields_of(file)
        images = read_images(file, path)
        looks = first_looks(file, path, stations, state)
    return _source(_Opened(path, options, tuple(stations), images, looks, fields, tuple(warnings)))


def _source(opened: _Opened) -> ScanSource:
    stations, images = opened.stations, opened.images
    has_colors, has_intensity = opened.has_colors, opened.has_intensity
    unused = [n for s in stations for n in s.fields if n not in s.used]
    return ScanSource(
        path=opened.path,
        format="e57",
        n_points=opened.n_points,
        pieces=partial(_pieces, opened),
        read_slice=partial(_slice, opened) if all(opened.n_fields[s.index] for s in stations) else None,
        settle=partial(_settled, opened) if opened.is_sample else None,
        unit="metre",
        cameras=images.cameras,
        read_photo=partial(read_photo, opened.path, images.blobs) if images.cameras else None,
        stations=tuple(s.pose.translation if s.pose else (0.0, 0.0, 0.0) for s in stations if s.has_scanner),
        has_normals=any(s.normal for s in stations),
        has_colors=has_colors,
        has_intensity=has_intensity,
        intensity_range=_intensity_range(opened) if has_intensity else None,
        bounds=_hull([s.bounds for s in stations]),
        warnings=(*opened.warnings, *_warnings(opened, has_colors, has_intensity), *images.warnings),
        unused=tuple(dict.fromkeys(unused)),
        details={
            "stations": [{"name": s.name, "points": s.n_points, "fields": list(s.fields)} for s in stations],
        },
    )


def _settled(opened: _Opened, looks: Looks) -> ScanSource | None:
    as_all = replace(opened, looks=tuple(looks.parts.get(i, look) for i, look in enumerate(opened.looks)))
    return None if as_all.decisions == opened.decisions else _source(as_all)


def _hull(boxes: list[tuple | None]) -> tuple | None:
    if not boxes or None in boxes:
        return None
    low, high = np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)
    return tuple(low.tolist()), tuple(high.tolist())


def _intensity_range(opened: _Opened) -> tuple[float, float] | None:
    limits = [s.intensity_limits for s, d in zip(opened.stations, opened.decisions, strict=True) if d.intensity]
    return None if None in limits else (min(low for low, _ in limits), max(high for _, high in limits))


def _warnings(opened: _Opened, has_colors: bool, has_intensity: bool) -> list[str]:
    found = []
    for station, look, decision in zip(opened.stations, opened.looks, opened.decisions, strict=True):
        if decision.top == 0:
            continue
        where, usual = f"{opened.path}:{station.name}", usual_top(station)
        if station.has_colors and not look.color.n_points:
            found.append(f"{where}: the colours of all points are marked as invalid and are not used")
            continue
        found += reasons(
            where,
            look,
            decision,
            station.has_colors,
            station.color_is_float,
            usual,
            station.has_intensity,
            station.n_points,
        )
        if (
            decision.top is not None
            and range_of(look.color, station.color_is_float, usual).usual
            and station.color_limits is None
        ):
            found.append(f"{where}: its colours declare no limits; taken as 0 to {decision.top:g}")
    bare = [s.name for s, d in zip(opened.stations, opened.decisions, strict=True) if d.top is None]
    if has_colors and bare:
        found.append(f"{opened.path}: stations {bare} have no colours; their points are drawn grey")
    dark = [s.name for s, d in zip(opened.stations, opened.decisions, strict=True) if not d.intensity]
    if not has_colors and has_intensity and dark:
        found.append(f"{opened.path}: stations {dark} have no intensity; their points are drawn in a middle grey")
    return found
