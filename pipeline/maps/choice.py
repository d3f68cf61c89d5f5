"""Which station shows a splat best: of those whose map has the splat's surface at its centre, the sharpest."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipeline.maps.sample import Squares, seen_at_centre
from pipeline.maps.station_map import StationMap

NO_STATION = -1
# Times as sharp that another station's map must be than that of the station which scanned the point: no other can be
# wrong about what that one saw.
OWN_BONUS = 2.0
STEEPEST_COSINE = 0.1  # beyond 84 degrees a texture is a smear


def best_stations(
    maps: Callable[[int], StationMap | None],
    n_stations: int,
    squares: Callable[[StationMap], Squares],  # the splats against the map's station
    own: np.ndarray,  # (n,) int64: the station that scanned each splat, NO_STATION where that is not known
) -> np.ndarray:
    """Stations (n,) int64; `own` where no map shows the splat, as what the map shows around it may still serve."""
    best, best_score = own.copy(), np.zeros(len(own))
    for i in range(n_stations):
        station_map = maps(i)
        if station_map is None:
            best[own == i] = NO_STATION
            continue
        found = squares(station_map)
        score = np.where(seen_at_centre(station_map, found), sharpness(station_map, found), 0.0)
        score *= np.where(own == i, OWN_BONUS, 1.0)
        better = score > best_score
        best[better], best_score[better] = i, score[better]
    return best


def sharpness(station_map: StationMap, squares: Squares) -> np.ndarray:
    """Texels of a map a unit of area, (n,); 0 where it is looked at too steeply."""
    distance = np.linalg.norm(squares.centre, axis=1)
    safe = np.maximum(distance, 1e-30)
    cosine = np.abs((squares.centre * squares.normal).sum(axis=1)) / safe
    projection = station_map.frame.projection
    pixels, _ = projection.project(squares.centre + np.asarray(projection.centre))
    with np.errstate(invalid="ignore"):
        found = cosine / (safe**2 * projection.footprint(pixels))
    return np.where((cosine > STEEPEST_COSINE) & (distance > 0), found, 0.0)
