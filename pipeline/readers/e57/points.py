"""The points of a station of an E57 file: rows through buffers of fixed size, where they lie, what marks they bear, how they look.

References: ASTM E2807-11, section 8.4.2; pye57#45 (reading in pieces).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from pye57 import libe57

from pipeline.execution.compiled import kernel
from pipeline.readers.attributes.decisions import WHOLE, Decision, Look, decide
from pipeline.readers.attributes.ranges import STRAYS, to_8_bits
from pipeline.readers.e57.kept import keep
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
FIRST_POINTS = 1 << 15  # of each station that are looked at where all would be too many

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
    if top:
        return to_8_bits(np.stack([rows[c] for c in COLOR], axis=1), top)
    # Limits are what the writer declared; a value beyond them is as bright as can be shown.
    color = np.empty((len(rows[COLOR[0]]), 3), np.uint8)
    for channel, (name, (low, high)) in enumerate(zip(COLOR, station.color_limits, strict=True)):
        _within(rows[name], low, high, color[:, channel])
    return color


@kernel(error_model="numpy")
def _within(values, low, high, levels):
    """Values (n,) of `low` to `high` as 0 to 255 in `levels` (n,); what is not finite is black."""
    span = high - low
    for i in range(len(values)):
        share = (values[i] - low) / span
        share = share if np.isfinite(share) else 0.0
        levels[i] = np.uint8(np.rint(min(max(share * 255.0, 0.0), 255.0)))


# --- points ---


def local_of(rows: Rows, station: Station) -> np.ndarray:  # (n, 3) float64
    """Positions (n, 3) float64 in the station's own frame, from Cartesian or spherical coordinates."""
    a, b, c = (rows[name] for name in station.coordinates)
    if station.coordinates == CARTESIAN:
        return np.stack([a, b, c], axis=1)
    # range, azimuth, elevation
    return np.stack([a * np.cos(c) * np.cos(b), a * np.cos(c) * np.sin(b), a * np.sin(c)], axis=1)


def masks_of(rows: Rows, station: Station, local: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Which points bear which marks; `local` their positions, where they are known already."""
    if station.coordinates == CARTESIAN:
        x, y, z = (rows[name] for name in CARTESIAN)
    else:
        x, y, z = (local_of(rows, station) if local is None else local).T
    masks = {"range-zero": (x == 0) & (y == 0) & (z == 0)}
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
    color = _but(color, masks.get("no-color", False) | nowhere)
    intensity = _but(intensity, masks.get("no-intensity", False) | nowhere)
    look.add(len(nowhere), color, intensity, masks)


def _but(values: np.ndarray | None, unknown: np.ndarray) -> np.ndarray | None:
    return values if values is None or not unknown.any() else values[~unknown]


def _buffers(file: libe57.ImageFile, names: list[str], capacity: int) -> tuple[Rows, libe57.VectorSourceDestBuffer]:
    arrays = {name: np.empty(capacity, np.float64) for name in names}
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in arrays.items():
        buffers.append(libe57.SourceDestBuffer(file, name, array, capacity, True, True))
    return arrays, buffers


def cut(columns: Rows, max_points: int) -> Iterator[Rows]:
    """Columns (n,) in runs of at most `max_points`."""
    for at in range(0, len(next(iter(columns.values()))), max_points):
        yield {name: column[at : at + max_points] for name, column in columns.items()}


def names_of(station: Station) -> list[str]:
    """The fields that are read."""
    return [name for name in dict.fromkeys(station.wanted) if name in station.fields]


def station_rows(file: libe57.ImageFile, where: str, station: Station, max_points: int, whole: bool) -> Iterator[Rows]:
    """The points of a station, in arrays that the next piece is read into; unless `whole`, of its first piece only."""
    names = names_of(station)
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


def first_looks(
    file: libe57.ImageFile, path: str, stations: list[Station], state: tuple[int, int, int]
) -> tuple[Look, ...]:
    """At all points of a small file, which are kept, else at the first of each station; `state` of the file before."""
    whole = sum(s.n_points for s in stations) <= WHOLE
    looks, kept = [], []
    for station in stations:
        look, most, columns = Look(), station.n_points if whole else FIRST_POINTS, {}
        for columns in station_rows(file, f"{path}:data3D[{station.index}]", station, most, whole):
            for rows in cut(columns, FIRST_POINTS):
                look_at(look, rows, station, masks_of(rows, station))
        looks.append(look)
        kept.append(columns)
    if whole and all(len(c[s.coordinates[0]]) == s.n_points for c, s in zip(kept, stations, strict=True)):
        keep(path, state, tuple(kept))
    return tuple(looks)
