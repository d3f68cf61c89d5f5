"""The unit of length that the coordinate system of a LAS header names, in WKT or in GeoTIFF keys.

References: OGC 01-009 and 18-010r7 (WKT 1 and 2); OGC 19-008r4 (GeoTIFF keys and their codes).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

METRE, FOOT, US_FOOT, DEGREE, UNKNOWN = "metre", "foot", "US survey foot", "degree", "unknown"
MAX_WKT_CHARS = 1 << 20
MAX_DEPTH = 64

_METRES = {1.0: METRE, 0.3048: FOOT, 1200 / 3937: US_FOOT}
_EPSG_UNITS = {9001: METRE, 9002: FOOT, 9003: US_FOOT}
_USER_DEFINED = 32767
_MODEL_TYPE, _PROJECTED_CRS, _LINEAR_UNIT, _LINEAR_UNIT_SIZE = 1024, 3072, 3076, 3077
_GEOGRAPHIC_MODEL = 2
_UTM_WGS84 = (range(32601, 32661), range(32701, 32761))

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


def unit_from_wkt(wkt: str) -> str:
    """The unit of the projected coordinates, "degree" for a geographic system, or "unknown"."""
    root = _parse_wkt(wkt)
    crs = root.children[0] if root.children else root
    if crs.keyword in ("COMPD_CS", "COMPOUNDCRS") and crs.children:
        crs = crs.children[0]
    if crs.keyword in ("GEOGCS", "GEOGCRS", "GEOGRAPHICCRS"):
        return DEGREE
    return _unit_of(crs) if crs.keyword in ("PROJCS", "PROJCRS", "PROJECTEDCRS", "LOCAL_CS", "ENGCRS") else UNKNOWN


def unit_from_geokeys(keys: dict[int, int], unit_size_m: float | None = None) -> str:
    """The same from GeoTIFF keys (id to value); `unit_size_m` is what key 3077 points to, if it is there."""
    if keys.get(_MODEL_TYPE) == _GEOGRAPHIC_MODEL:
        return DEGREE
    code = keys.get(_LINEAR_UNIT)
    if code == _USER_DEFINED and unit_size_m:
        return _named(unit_size_m, "unit")
    if code is None and any(keys.get(_PROJECTED_CRS) in zone for zone in _UTM_WGS84):
        return METRE
    return _EPSG_UNITS.get(code, UNKNOWN)
