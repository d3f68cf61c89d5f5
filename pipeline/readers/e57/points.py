"""The points of a station of an E57 file: rows through buffers of fixed size, where they lie, what marks they bear, how they look.

References: ASTM E2807-11, section 8.4.2; pye57#45 (reading in pieces).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from pye57 import libe57

from pipeline.readers.attributes.decisions import Decision, Look, decide
from pipeline.readers.attributes.ranges import STRAYS, to_8_bits
from pipeline.readers.e57.stations import (
    CARTESIAN,
    COLOR,
    COLOR_INVALID,
    INTENSITY,
    INTENSITY_INVALID,
    INVALID,
    Station,
)
from storage.errors import InvalidScan

# Declared limits are left where the values fill less than this share of them, as 8-bit values in limits of 16 bits do.
LEAST_FILLED = 1 / 16

Rows = dict[str, np.ndarray]


# --- what the values range over ---


def usual_top(station: Station) -> float:
    """What white usually is, by a station's declared limits or the type of its colours."""
    return station.color_limits[0][1] if station.color_limits else 1.0 if station.color_is_float else 255.0


def decide_station(station: Station, look: Look) -> Decision:
    """What a station's colours and intensities are taken for, from values that were looked at."""
    attributes = (station.has_colors, station.color_is_float, usual_top(station), station.has_intensity)
    decision = decide(look, *attributes)
    if decision.top is not None and _trusts_limits(station, look, decision.top):
        return Decision(0.0, decision.intensity, decision.ignored)  # 0: by the declared limits
    return decision


def _trusts_limits(station: Station, look: Look, top: float) -> bool:
    """Whether declared limits hold the values, and are not much wider than these."""
    if station.color_limits is None:
        return False
    low, high = station.color_limits[0]
    beyond = {1.0: 1.001, 255.0: 256.0, 1023.0: 1024.0, 4095.0: 4096.0, 65535.0: 65536.0}.get(high)
    fits = look.color.share_above(beyond) <= STRAYS if beyond else look.color.highest <= high * (1 + 1e-6)
    return fits and (low != 0 or top >= LEAST_FILLED * high)


def color_of(rows: Rows, station: Station, top: float) -> np.ndarray:  # (n, 3) uint8
    """Colours (n, 3) uint8; `top` is what white is, 0 by the declared limits."""
    values = np.stack([rows[c] for c in COLOR], axis=1)
    if top:
        return to_8_bits(values, top)
    low, high = np.array(station.color_limits).T
    # Limits are what the writer declared; a value beyond them is as bright as can be shown.
    return to_8_bits((values - low) / (high - low), 1.0)


# --- points ---


def local_of(rows: Rows, station: Station) -> np.ndarray:  # (n, 3) float64
    """Positions (n, 3) float64 in the station's own frame, from Cartesian or spherical coordinates."""
    a, b, c = (rows[name] for name in station.coordinates)
    if station.coordinates == CARTESIAN:
        return np.stack([a, b, c], axis=1)
    # range, azimuth, elevation
    return np.stack([a * np.cos(c) * np.cos(b), a * np.cos(c) * np.sin(b), a * np.sin(c)], axis=1)


def masks_of(rows: Rows, station: Station, local: np.ndarray) -> dict[str, np.ndarray]:
    """Which points bear which marks."""
    masks = {"range-zero": (local == 0).all(axis=1)}
    for name, state in (
        ("invalid", INVALID[station.coordinates]),
        ("no-color", COLOR_INVALID),
        ("no-intensity", INTENSITY_INVALID),
    ):
        if state in rows:
            masks[name] = rows[state] != 0
    return masks


def look_at(look: Look, rows: Rows, station: Station, masks: dict[str, np.ndarray]) -> None:
    """At what was measured: colours and intensities that are marked as invalid tell nothing of others."""
    color = np.stack([rows[c] for c in COLOR], axis=1) if station.has_colors else None
    intensity = rows.get(INTENSITY)
    nowhere = masks["range-zero"] | masks.get("invalid", False)
    if color is not None:
        color = color[~(masks.get("no-color", False) | nowhere)]
    if intensity is not None:
        intensity = intensity[~(masks.get("no-intensity", False) | nowhere)]
    look.add(len(nowhere), color, intensity, masks)


def _buffers(file: libe57.ImageFile, names: list[str], capacity: int) -> tuple[Rows, libe57.VectorSourceDestBuffer]:
    arrays = {name: np.empty(capacity, np.float64) for name in names}
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in arrays.items():
        buffers.append(libe57.SourceDestBuffer(file, name, array, capacity, True, True))
    return arrays, buffers


def station_rows(file: libe57.ImageFile, where: str, station: Station, max_points: int, whole: bool) -> Iterator[Rows]:
    """The points of a station; unless `whole`, of its first piece only."""
    names = [name for name in dict.fromkeys(station.used) if name in station.fields]
    arrays, buffers = _buffers(file, names, max(1, min(max_points, station.n_points)))
    points = file.root()["data3D"][station.index]["points"]
    reader = points.reader(buffers)
    n_read = 0
    try:
        while n := reader.read():
            n_read += n
            yield {name: array[:n] for name, array in arrays.items()}
            if not whole:
                return
    finally:
        reader.close()
    if n_read != station.n_points:
        raise InvalidScan(f"{where}.points", f"{n_read} points read", f"{station.n_points}, as the header promises")
