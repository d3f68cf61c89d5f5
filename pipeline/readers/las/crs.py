"""The units of length that the coordinate system of a LAS header names, in WKT or in GeoTIFF keys: across and up.

A system that is given by its EPSG code alone is looked up by pyproj.

References: OGC 01-009 and 18-010r7 (WKT 1 and 2); OGC 19-008r4 (GeoTIFF keys and their codes).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Protocol

METRE, FOOT, US_FOOT, DEGREE, UNKNOWN = "metre", "foot", "US survey foot", "degree", "unknown"
MAX_WKT_CHARS = 1 << 20
MAX_DEPTH = 64

_METRES = {1.0: METRE, 0.3048: FOOT, 1200 / 3937: US_FOOT}
_EPSG_UNITS = {9001: METRE, 9002: FOOT, 9003: US_FOOT}
_USER_DEFINED = 32767
_MODEL_TYPE, _PROJECTED_CRS, _LINEAR_UNIT, _LINEAR_UNIT_SIZE = 1024, 3072, 3076, 3077
_VERTICAL_CRS, _VERTICAL_UNIT = 4096, 4099
_GEOGRAPHIC_MODEL = 2
_GEODETIC = ("GEODCRS", "GEODETICCRS")
_GEOCENTRIC = ("GEOCCS", *_GEODETIC)
EARTH_CENTRED = "its coordinates are counted from the earth's centre: up, which is taken to be z, is not; turn them into a projected system first"

_TOKEN = re.compile(r'"(?:[^"]|"")*"|[A-Za-z_][A-Za-z0-9_]*\s*[\[(]|[\])]|[^,\s"\[\]()]+')


@dataclass
class _Node:
    keyword: str
    values: list[str] = field(default_factory=list)
    children: list[_Node] = field(default_factory=list)

    def find(self, *keywords: str) -> _Node | None:
        return next((c for c in self.children if c.keyword in keywords), None)


def _parse_wkt(wkt: str) -> _Node:
    """The tree of a WKT; what is nested deeper than any real system counts as the end."""
    stack = [_Node("")]
    for token in _TOKEN.findall(wkt[:MAX_WKT_CHARS]):
        if len(stack) > MAX_DEPTH:
            break
        if token[-1] in "[(" and token[0] != '"':
            node = _Node(token[:-1].strip().upper())
            stack[-1].children.append(node)
            stack.append(node)
        elif token in "])":
            if len(stack) > 1:
                stack.pop()
        else:
            stack[-1].values.append(token.strip('"'))
    return stack[0]


def _named(metres: float, name: str) -> str:
    if not 0 < metres < 1e12:
        return UNKNOWN
    for known, unit in _METRES.items():
        # International and US survey foot differ by 2e-6 of themselves.
        if abs(metres / known - 1) < 5e-7:
            return unit
    return f"{name} ({metres:g} m)"


def _unit_of(crs: _Node) -> str:
    axes = [c for c in crs.children if c.keyword == "AXIS"]
    for node in (crs, *axes):
        unit = node.find("UNIT", "LENGTHUNIT")
        if unit and len(unit.values) >= 2:
            try:
                return _named(float(unit.values[1]), unit.values[0])
            except ValueError:
                return UNKNOWN
    return UNKNOWN


def _metres_of(unit: str) -> float | None:
    """How many metres a unit has, by the names that this file gives."""
    return next((m for m, name in _METRES.items() if name == unit), None)


def _units_of(root: _Node) -> tuple[str, str]:
    """The units across and up; the latter "unknown" where the system says nothing of heights."""
    crs = root.children[0] if root.children else root
    while crs.keyword in ("BOUNDCRS", "SOURCECRS") and crs.children:
        crs = crs.children[0]
    parts = crs.children if crs.keyword in ("COMPD_CS", "COMPOUNDCRS") else [crs]
    vertical = next((p for p in parts if p.keyword in ("VERT_CS", "VERTCS", "VERTCRS", "VERTICALCRS")), None)
    up = _unit_of(vertical) if vertical else UNKNOWN
    for part in parts:
        if part.keyword in ("GEOGCS", "GEOGCRS", "GEOGRAPHICCRS") or _is_ellipsoidal(part):
            return DEGREE, up
        if part.keyword in _GEOCENTRIC:
            return _unit_of(part), up
        if part.keyword in ("PROJCS", "PROJCRS", "PROJECTEDCRS", "LOCAL_CS", "ENGCRS"):
            return _unit_of(part), up
    return UNKNOWN, up


def _is_ellipsoidal(part: _Node) -> bool:
    """Whether a geodetic system has latitudes and longitudes, not places from the earth's centre."""
    kind = part.find("CS")
    return part.keyword in _GEODETIC and kind is not None and kind.values[:1] == ["ellipsoidal"]


def _is_geocentric(root: _Node) -> bool:
    """Whether places are counted from the earth's centre, so that up is not along z."""
    crs = root.children[0] if root.children else root
    return crs.keyword in _GEOCENTRIC and not _is_ellipsoidal(crs)


def unit_from_wkt(wkt: str) -> str:
    """The unit of the projected coordinates, "degree" for a geographic system, or "unknown"."""
    return _units_of(_parse_wkt(wkt))[0]


def unit_from_geokeys(keys: dict[int, int], unit_size_m: float | None = None) -> str:
    """The same from GeoTIFF keys (id to value); `unit_size_m` is what key 3077 points to, if it is there."""
    if keys.get(_MODEL_TYPE) == _GEOGRAPHIC_MODEL:
        return DEGREE
    code = keys.get(_LINEAR_UNIT)
    if code == _USER_DEFINED and unit_size_m:
        return _named(unit_size_m, "unit")
    if code is None:
        return _unit_of_epsg(keys.get(_PROJECTED_CRS))
    return _EPSG_UNITS.get(code, UNKNOWN)


def _unit_of_epsg(code: int | None) -> str:
    """Of the first axis of a coordinate system in the EPSG's list."""
    if not code or code == _USER_DEFINED:
        return UNKNOWN
    import pyproj  # takes 0.2 s to import, for few scans

    try:
        axis = pyproj.CRS.from_epsg(code).axis_info[0]
    except (pyproj.exceptions.CRSError, IndexError):
        return UNKNOWN
    return DEGREE if axis.unit_name == "degree" else _named(axis.unit_conversion_factor, axis.unit_name)


# --- records of a LAS header ---


@dataclass(frozen=True)
class Units:
    """What lengths are in; "unknown" where nothing says so."""

    horizontal: str = UNKNOWN
    vertical: str = UNKNOWN
    warnings: tuple[str, ...] = ()

    @property
    def differ(self) -> bool:
        return UNKNOWN not in (self.horizontal, self.vertical) and self.horizontal not in (self.vertical, DEGREE)

    @property
    def height_scale(self) -> float:
        """What heights are multiplied by to be in the horizontal unit; 1 where that cannot be told."""
        across, up = _metres_of(self.horizontal), _metres_of(self.vertical)
        return up / across if across and up else 1.0


class HasContent(Protocol):
    """A variable length record."""

    user: str
    id: int
    content: bytes


_WKT, _KEYS, _DOUBLES = 2112, 34735, 34736


def units_from_records(records: Iterable[HasContent]) -> Units:
    """The units that the records of a LAS header name; what cannot be read is said, and the rest used."""
    of_crs = [r for r in records if r.user.strip() == "LASF_Projection"]
    warnings: list[str] = []
    for record in (r for r in of_crs if r.id == _WKT):
        across, up = _units_of(root := _parse_wkt(_decoded(record.content)))
        if across != UNKNOWN:
            return Units(across, up, (EARTH_CENTRED,) if _is_geocentric(root) else ())
        if record.content.strip(b"\0 \n"):
            warnings.append("its coordinate system (WKT) names no unit that can be read")
    shorts = next((r.content for r in of_crs if r.id == _KEYS), b"")
    doubles = next((r.content for r in of_crs if r.id == _DOUBLES), b"")
    numbers = struct.unpack(f"<{len(shorts) // 2}H", shorts[: len(shorts) // 2 * 2])
    keys = {numbers[i]: numbers[i + 3] for i in range(4, len(numbers) - 3, 4)}
    at = 8 * keys.get(_LINEAR_UNIT_SIZE, 1 << 16)
    size = struct.unpack_from("<d", doubles, at)[0] if at + 8 <= len(doubles) else None
    vertical = _EPSG_UNITS.get(keys.get(_VERTICAL_UNIT)) or _unit_of_epsg(keys.get(_VERTICAL_CRS))
    return Units(unit_from_geokeys(keys, size), vertical, tuple(warnings))


def _decoded(content: bytes) -> str:
    """WKT is ASCII by the standard; names of places are what writers leave in UTF-8 or Latin-1."""
    content = content.rstrip(b"\0")
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError:
        return content.decode("latin-1")
