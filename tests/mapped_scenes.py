"""Tiny scenes textured from the map of a station that looks at a wall, of which it saw a part: void, and a post before
it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.cameras.polar_capped import PolarCapped
from pipeline.maps.sample import ALL_LEVELS
from pipeline.maps.station_map import MapFrame, StationMap, encode_distances
from pipeline.maps.stored import encode_map
from storage.maps import NO_MAP
from storage.packed.packed import PackedScene

STATION = np.array([0.1, -1.0, 0.15])


def wall_map(station: np.ndarray = STATION, height: int = 160) -> StationMap:
    """What a station before the plane y = 0 saw of it: its part |x| < 0.4, z > -0.3, in waves of colour, with a post
    before it."""
    projection = PolarCapped(tuple(station), height)
    column, row = np.meshgrid(np.arange(6 * height) + 0.5, np.arange(height) + 0.5)
    ray = projection.unproject(np.stack([column.ravel(), row.ravel()], axis=1), np.ones(6 * height**2)) - station
    with np.errstate(divide="ignore"):
        away = np.where(ray[:, 1] > 0, -station[1] / ray[:, 1], np.inf)
        point = station + np.where(np.isfinite(away), away, 0)[:, None] * ray
        post = -0.5 * station[1] / ray[:, 1]
    seen = np.isfinite(away) & (np.abs(point[:, 0]) < 0.4) & (point[:, 2] > -0.3) & (point[:, 2] < 0.6)
    is_post = seen & (np.abs(station[0] + post * ray[:, 0] - 0.05) < 0.05)
    distance = np.where(is_post, post, np.where(seen, away, np.inf)).reshape(height, -1)
    waves = 128 + 110 * np.sin(point @ np.array([[25.0, 9, 4], [0, 0, 0], [7, 30, 12]]))
    color = np.where(is_post[:, None], [250, 20, 20], waves)
    rgba = np.concatenate([np.where(seen[:, None], color, 0), 255 * seen[:, None]], axis=1)
    frame = MapFrame(0, tuple(station.tolist()), height, 0.3, 3.0)
    return StationMap(frame, rgba.reshape(height, -1, 4).astype(np.uint8), encode_distances(distance, frame))


def moved(station_map: StationMap, by) -> StationMap:
    """The same map of a station elsewhere."""
    centre = tuple(np.add(station_map.frame.centre, by).tolist())
    return replace(station_map, frame=replace(station_map.frame, centre=centre))


def with_maps(scene: PackedScene, *maps: StationMap, station: np.ndarray | None = None) -> PackedScene:
    """A scene without a dictionary whose splats have maps, each splat that of its `station`, the first where not
    said."""
    made = [encode_map(m, ALL_LEVELS, 40.0) for m in maps]
    station = np.zeros(scene.header.n_splats, int) if station is None else station
    arrays = {
        "station": np.where(station < 0, NO_MAP, station).astype(np.uint8),
        "map_colors": np.concatenate([m.color for m in made]),
        "map_depth_low": np.concatenate([m.depth_low.ravel() for m in made]),
        "map_depth_high": np.concatenate([m.depth_high.ravel() for m in made]),
    }
    header = replace(scene.header, maps=tuple(m.stored for m in made))
    return PackedScene(header, scene.arrays | arrays)
