"""The stations of an E57 file: what their points hold, in what ranges, and whether a scanner stood there.

References: ASTM E2807-11, section 8.4.2; the normals extension of libE57 ("nor").
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from pye57 import libe57

from pipeline.readers.attributes.names import Columns, columns_of
from pipeline.readers.e57.nodes import Pose, number, read_pose
from storage.errors import InvalidScan, UnsupportedScan

CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
INVALID = {CARTESIAN: "cartesianInvalidState", SPHERICAL: "sphericalInvalidState"}
COLOR = ("colorRed", "colorGreen", "colorBlue")
COLOR_INVALID = "isColorInvalid"
INTENSITY, INTENSITY_INVALID = "intensity", "isIntensityInvalid"
_GRID = ("rowIndex", "columnIndex")


@dataclass(frozen=True)
class Station:
    """One entry of data3D: what its points hold and how to read it."""

    index: int  # in data3D
    name: str
    n_points: int
    fields: tuple[str, ...]
    coordinates: tuple[str, str, str]
    pose: Pose | None
    color_limits: tuple[tuple[float, float], ...] | None  # (3) declared lowest and highest value of each channel
    color_is_float: bool
    intensity_limits: tuple[float, float] | None
    bounds: tuple[tuple[float, float, float], tuple[float, float, float]] | None
    columns: Columns = field(default_factory=Columns)

    @property
    def has_colors(self) -> bool:
        return set(COLOR) <= set(self.fields)

    @property
    def has_intensity(self) -> bool:
        return INTENSITY in self.fields

    @property
    def normal(self) -> tuple[str, ...]:
        return self.columns.normal

    @property
    def has_scanner(self) -> bool:
        """Whether its origin is where a scanner stood: it has a pose, rows and columns, or directions and ranges.

        A cloud that somebody merged has none of them.
        """
        return self.pose is not None or set(_GRID) <= set(self.fields) or self.coordinates == SPHERICAL

    @property
    def used(self) -> tuple[str, ...]:
        """Fields that say something: rows and columns only by being there."""
        return (*self.wanted, *_GRID)

    @property
    def wanted(self) -> tuple[str, ...]:
        """Fields whose values are read, where they are there."""
        states = (INVALID[self.coordinates], COLOR_INVALID, INTENSITY_INVALID)
        return (*self.coordinates, *states, *COLOR, INTENSITY, *self.normal)


def read_station(scan: libe57.StructureNode, index: int, where: str) -> Station:
    """One entry of data3D. Raises: InvalidScan, UnsupportedScan for points without coordinates."""
    name = scan["name"].value() if scan.isDefined("name") else f"data3D[{index}]"
    if not scan.isDefined("points"):
        raise InvalidScan(f"{where}.points", "missing", "the points of the scan")
    prototype = libe57.StructureNode(scan["points"].prototype())
    fields = tuple(prototype.get(i).elementName() for i in range(prototype.childCount()))
    coordinates = next((c for c in (CARTESIAN, SPHERICAL) if set(c) <= set(fields)), None)
    if coordinates is None:
        raise UnsupportedScan(f"{where}.points", f"fields {list(fields)}", f"{CARTESIAN} or {SPHERICAL}")
    pose = read_pose(scan, where)
    station = Station(
        index=index,
        name=name,
        n_points=int(scan["points"].childCount()),
        fields=fields,
        coordinates=coordinates,
        pose=pose,
        color_limits=None,
        color_is_float=False,
        intensity_limits=_limits(scan, "intensityLimits", INTENSITY) if INTENSITY in fields else None,
        bounds=_bounds(scan, pose),
        columns=columns_of(fields),
    )
    if not station.has_colors:
        return station
    limits = tuple(_limits(scan, "colorLimits", c) for c in COLOR)
    is_float = isinstance(prototype[COLOR[0]], libe57.FloatNode)
    return replace(station, color_limits=None if None in limits else limits, color_is_float=is_float)


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
