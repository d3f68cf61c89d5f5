"""E57 through libe57: several stations with their poses, read in pieces through buffers of fixed size.

Cartesian or spherical coordinates; points whose state says invalid get NaN positions, so the count stays what the
header promises and the ingest counts them with the other NaN. Positions are float64, in metres by the standard.

References: ASTM E2807-11, section 8.4.2; pye57#45 (reading in pieces).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from pye57 import libe57

from pipeline.readers.e57.images import read_images, read_photo
from pipeline.readers.e57.nodes import Pose, number, open_image_file, read_pose
from pipeline.readers.e57.packets import BitField, bit_fields, packets_of, read_points
from pipeline.scan import Piece, ScanSource
from storage.errors import InvalidScan, UnsupportedScan

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_INVALID = {_CARTESIAN: "cartesianInvalidState", _SPHERICAL: "sphericalInvalidState"}
_COLOR = ("colorRed", "colorGreen", "colorBlue")
_INTENSITY, _INTENSITY_INVALID = "intensity", "isIntensityInvalid"


@dataclass(frozen=True)
class Station:
    """One entry of data3D: what its points hold and how to read it."""

    name: str
    n_points: int
    fields: tuple[str, ...]
    coordinates: tuple[str, str, str]
    pose: Pose | None
    color_limits: tuple[tuple[float, float], ...] | None  # (3) lowest and highest value of each channel
    intensity_limits: tuple[float, float] | None
    bounds: tuple[tuple[float, float, float], tuple[float, float, float]] | None

    @property
    def has_colors(self) -> bool:
        return set(_COLOR) <= set(self.fields)

    @property
    def has_intensity(self) -> bool:
        return _INTENSITY in self.fields


# --- header ---


def _limits(scan: libe57.StructureNode, group: str, field: str) -> tuple[float, float] | None:
    """The declared range of a field, from the scan's limits, else from the prototype of its points."""
    low, high = f"{field}Minimum", f"{field}Maximum"
    if scan.isDefined(group) and scan[group].isDefined(low) and scan[group].isDefined(high):
        limits = float(number(scan[group][low])), float(number(scan[group][high]))
    else:
        node = libe57.StructureNode(scan["points"].prototype())[field]
        is_scaled = isinstance(node, libe57.ScaledIntegerNode)
        ends = (node.scaledMinimum(), node.scaledMaximum()) if is_scaled else (node.minimum(), node.maximum())
        limits = float(ends[0]), float(ends[1])
    # Without declared bounds a node gives those of its type, up to 1e308: no range to scale by.
    return limits if np.isfinite(limits).all() and 0 < limits[1] - limits[0] < 2**32 else None


def _color_limits(scan: libe57.StructureNode, where: str) -> tuple[tuple[float, float], ...]:
    limits = tuple(_limits(scan, "colorLimits", field) for field in _COLOR)
    if None in limits:
        raise InvalidScan(f"{where}.colorLimits", f"{limits}", "a minimum below a maximum for each channel")
    return limits


def _bounds(scan: libe57.StructureNode, pose: Pose | None) -> tuple | None:
    """The declared box, where no pose leaves it open whether the box is local or global: writers do both."""
    if not scan.isDefined("cartesianBounds") or pose not in (None, Pose()):
        return None
    box = scan["cartesianBounds"]
    names = [[f"{axis}{end}" for axis in "xyz"] for end in ("Minimum", "Maximum")]
    if not all(box.isDefined(n) for row in names for n in row):
        return None
    low, high = ([float(number(box[n])) for n in row] for row in names)
    # Unset bounds are the ends of the number range.
    return (tuple(low), tuple(high)) if np.abs([low, high]).max() < 1e300 else None


def _read_station(scan: libe57.StructureNode, where: str) -> Station:
    if not scan.isDefined("points"):
        raise InvalidScan(f"{where}.points", "missing", "the points of the scan")
    prototype = libe57.StructureNode(scan["points"].prototype())
    fields = tuple(prototype.get(i).elementName() for i in range(prototype.childCount()))
    coordinates = next((c for c in (_CARTESIAN, _SPHERICAL) if set(c) <= set(fields)), None)
    if coordinates is None:
        raise UnsupportedScan(f"{where}.points", f"fields {list(fields)}", f"{_CARTESIAN} or {_SPHERICAL}")
    pose = read_pose(scan, where)
    return Station(
        name=scan["name"].value() if scan.isDefined("name") else where.rpartition(":")[2],
        n_points=int(scan["points"].childCount()),
        fields=fields,
        coordinates=coordinates,
        pose=pose,
        color_limits=_color_limits(scan, where) if set(_COLOR) <= set(fields) else None,
        intensity_limits=_limits(scan, "intensityLimits", _INTENSITY) if _INTENSITY in fields else None,
        bounds=_bounds(scan, pose),
    )


def _hull(boxes: list[tuple | None]) -> tuple | None:
    if not boxes or None in boxes:
        return None
    low, high = np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)
    return tuple(low.tolist()), tuple(high.tolist())


def _intensity_range(stations: tuple[Station, ...]) -> tuple[float, float] | None:
    limits = [s.intensity_limits for s in stations]
    return None if None in limits else (min(low for low, _ in limits), max(high for _, high in limits))


# --- points ---


def _buffers(
    file: libe57.ImageFile, names: list[str], capacity: int
) -> tuple[dict[str, np.ndarray], libe57.VectorSourceDestBuffer]:
    arrays = {name: np.empty(capacity, np.float64) for name in names}
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in arrays.items():
        buffers.append(libe57.SourceDestBuffer(file, name, array, capacity, True, True))
    return arrays, buffers


def _position(rows: dict[str, np.ndarray], station: Station) -> np.ndarray:  # (n, 3) float64
    a, b, c = (rows[name] for name in station.coordinates)
    if station.coordinates == _CARTESIAN:
        local = np.stack([a, b, c], axis=1)
    else:  # range, azimuth, elevation
        local = np.stack([a * np.cos(c) * np.cos(b), a * np.cos(c) * np.sin(b), a * np.sin(c)], axis=1)
    invalid = rows.get(_INVALID[station.coordinates])
    if invalid is not None:
        local[invalid != 0] = np.nan
    return local if station.pose is None else station.pose.apply(local)


def _color(rows: dict[str, np.ndarray], station: Station) -> np.ndarray:  # (n, 3) uint8
    scaled = [(rows[name] - low) / (high - low) for name, (low, high) in zip(_COLOR, station.color_limits, strict=True)]
    # Limits are what the writer declared; a value beyond them is as bright as can be shown.
    return np.rint(np.clip(np.nan_to_num(np.stack(scaled, axis=1)), 0, 1) * 255).astype(np.uint8)


def _intensity(rows: dict[str, np.ndarray]) -> np.ndarray:  # (n,) float32
    intensity = rows[_INTENSITY].astype(np.float32)
    if _INTENSITY_INVALID in rows:
        intensity[rows[_INTENSITY_INVALID] != 0] = np.nan
    return intensity


def _read_names(station: Station, has_colors: bool, has_intensity: bool) -> list[str]:
    wanted = [*station.coordinates, _INVALID[station.coordinates]]
    wanted += _COLOR if has_colors else ()
    wanted += (_INTENSITY, _INTENSITY_INVALID) if has_intensity else ()
    return [name for name in wanted if name in station.fields]


def _station_pieces(
    points: libe57.CompressedVectorNode, where: str, station: Station, names: list[str], max_points: int
) -> Iterator[dict[str, np.ndarray]]:
    arrays, buffers = _buffers(points.destImageFile(), names, max(1, min(max_points, station.n_points)))
    reader = points.reader(buffers)
    n_read = 0
    try:
        while n := reader.read():
            n_read += n
            yield {name: array[:n] for name, array in arrays.items()}
    finally:
        reader.close()
    if n_read != station.n_points:
        raise InvalidScan(f"{where}.points", f"{n_read} points read", f"{station.n_points}, as the header promises")


def _pieces(
    path: str, stations: tuple[Station, ...], has_colors: bool, has_intensity: bool, max_points: int
) -> Iterator[Piece]:
    if max_points < 1:
        raise ValueError(f"max_points {max_points}; allowed: 1 or more")
    with open_image_file(path) as file:
        for i, station in enumerate(stations):
            names = _read_names(station, has_colors, has_intensity)
            points = file.root()["data3D"][i]["points"]
            for rows in _station_pieces(points, f"{path}:data3D[{i}]", station, names, max_points):
                yield _piece(rows, i, station, has_colors, has_intensity)


def _slice(
    path: str,
    stations: tuple[Station, ...],
    fields: tuple[tuple[BitField, ...], ...],
    has_colors: bool,
    has_intensity: bool,
    first: int,
    stop: int,
    max_points: int,
) -> Iterator[Piece]:
    """Points first..stop of all stations in a row, without those before them."""
    packets, before = packets_of(path, tuple(map(len, fields))), 0
    for i, station in enumerate(stations):
        names = _read_names(station, has_colors, has_intensity)
        for at in range(max(0, first - before), min(station.n_points, stop - before), max_points):
            end = min(at + max_points, station.n_points, stop - before)
            rows = read_points(path, packets[i], fields[i], names, at, end)
            yield _piece(rows, i, station, has_colors, has_intensity)
        before += station.n_points


def _piece(rows: dict[str, np.ndarray], i: int, station: Station, has_colors: bool, has_intensity: bool) -> Piece:
    position = _position(rows, station)
    return Piece(
        position=position,
        color=_color(rows, station) if has_colors else None,
        intensity=_intensity(rows) if has_intensity else None,
        station=np.full(len(position), i, np.int32),
    )


# --- public ---


def _warnings(path: str, stations: tuple[Station, ...]) -> list[str]:
    warnings = []
    for what, has in (("colours", "has_colors"), ("intensity", "has_intensity")):
        without = [s.name for s in stations if not getattr(s, has)]
        if without and len(without) < len(stations):
            warnings.append(f"{path}: stations {without} have no {what}, so {what} of the others are not used")
    return warnings


def open_e57(path: str) -> ScanSource:
    """An E57 file: all its scans one after the other, and its posed pinhole images as cameras.

    Guarantees: memory for points is that of one piece; every station's pose is applied in float64.
    Raises: InvalidScan for a file that is truncated or damaged or contradicts itself; UnsupportedScan for points
    without coordinates.
    """
    with open_image_file(path) as file:
        scans = file.root()["data3D"] if file.root().isDefined("data3D") else []
        stations = tuple(_read_station(scan, f"{path}:data3D[{i}]") for i, scan in enumerate(scans))
        fields = tuple(bit_fields(libe57.StructureNode(scan["points"].prototype())) for scan in scans)
        images = read_images(file, path)
    has_colors = bool(stations) and all(s.has_colors for s in stations)
    has_intensity = bool(stations) and all(s.has_intensity for s in stations)
    return ScanSource(
        path=path,
        format="e57",
        n_points=sum(s.n_points for s in stations),
        pieces=partial(_pieces, path, stations, has_colors, has_intensity),
        read_slice=partial(_slice, path, stations, fields, has_colors, has_intensity) if None not in fields else None,
        unit="metre",
        cameras=images.cameras,
        read_photo=partial(read_photo, path, images.blobs) if images.cameras else None,
        stations=tuple((s.pose or Pose()).translation for s in stations),
        has_colors=has_colors,
        has_intensity=has_intensity,
        intensity_range=_intensity_range(stations) if has_intensity else None,
        bounds=_hull([s.bounds for s in stations]),
        warnings=(*_warnings(path, stations), *images.warnings),
        details={
            "stations": [{"name": s.name, "points": s.n_points, "fields": list(s.fields)} for s in stations],
        },
    )
