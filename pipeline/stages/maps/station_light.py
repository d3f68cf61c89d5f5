"""Stations brought to one light, from splats that the maps of several of them show."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.effects.exposure.light import MOST_GAIN, N_TERMS
from pipeline.effects.exposure.solve import Observations, solve_fields, spread
from pipeline.maps.choice import sharpness
from pipeline.maps.sample import Squares, sample_patches, seen_at_centre
from pipeline.maps.station_map import StationMap
from pipeline.numerics.srgb import LINEAR_OF_LEVEL
from pipeline.stages.maps.resample_maps import MappedSplats
from pipeline.texture.resample import disc_weights
from storage.packed.schema import PATCH_SIZE
from storage.work import arrays

MOST_BLOCKS = 16
EVERY = 32  # splats of a block
LEAST_SHARE = 0.9  # of a splat's square that a map must show
# Levels of 255 by which the median spread of a splat's colours across stations must fall: less is what rounding makes
# of equal ones.
LEAST_FALL = 1.0


@dataclass(frozen=True)
class StationGains:
    """What brings stations to one light. Spreads are medians over splats of their colours across stations, in levels
    of 255; None where no splat is seen from two."""

    log_gain: tuple[tuple[float, float, float], ...]  # by station and channel
    n_splats: int
    spread_before: float | None
    spread_after: float | None


@dataclass(frozen=True)
class LightSeen:
    """What a task tells of its block: splats, each with a station and what that saw of it, three values."""

    n_splats: int
    splat: list[int]
    station: list[int]
    light: list[float]


@dataclass(frozen=True)
class StationLight:
    """A task a block, of at most MOST_BLOCKS blocks. The summary has `log_gain` (n_stations, 3): zeros where gains
    solved from half of the splats do not bring the other half together by LEAST_FALL."""

    of: MappedSplats
    name = "station-light"

    def init(self, folder: Path) -> int:
        return min(MOST_BLOCKS, arrays.n_blocks(self.of.n_splats))

    def run(self, folder: Path, index: int) -> LightSeen:
        n = self.of.n_splats
        n_blocks = arrays.n_blocks(n)
        chosen = index * n_blocks // min(MOST_BLOCKS, n_blocks)
        start, stop = arrays.block_range(chosen, n)
        block = self.of.block(start, stop)
        rows = np.arange(0, stop - start, EVERY)
        seen = LightSeen(stop - start, [], [], [])
        for station in range(self.of.n_stations):
            station_map = self.of.map_of(station)
            if station_map is None:
                continue
            found, light = _light_of(station_map, block.squares(station_map).only(rows))
            seen.splat.extend(found.tolist())
            seen.station.extend([station] * len(found))
            seen.light.extend(light.round(6).ravel().tolist())
        return seen

    def finalise(self, folder: Path, results: list[LightSeen]) -> StationGains:
        n_stations = self.of.n_stations
        splat = np.concatenate([np.array(r.splat, np.int64) + (i << 20) for i, r in enumerate(results)])
        station = np.concatenate([np.array(r.station, np.int64) for r in results])
        light = np.concatenate([np.array(r.light, float).reshape(-1, 3) for r in results])
        several = _several(splat)
        nowhere = np.zeros(int(several.sum()))  # a station's light is the same all around
        seen = Observations(splat[several], station[several], nowhere, nowhere, light[several])
        return _gains(seen, n_stations)


def _gains(seen: Observations, n_stations: int) -> StationGains:
    none = StationGains(((0.0, 0.0, 0.0),) * n_stations, len(np.unique(seen.splat)), None, None)
    if not len(seen.splat):
        return none
    even = seen.splat % 2 == 0
    of_half = solve_fields(seen.only(even), n_stations)
    before, after = spread(seen.only(~even)), spread(seen.only(~even), of_half)
    found = replace(none, spread_before=before, spread_after=after)
    if before - after < LEAST_FALL:
        return found
    most = np.log(MOST_GAIN)
    fields = solve_fields(seen, n_stations, of_half).reshape(n_stations, 3, N_TERMS)
    gains = np.clip(fields[:, :, 0], -most, most).round(5).tolist()
    return replace(found, log_gain=tuple(map(tuple, gains)))


def _light_of(station_map: StationMap, squares: Squares) -> tuple[np.ndarray, np.ndarray]:
    """Which splats a map shows nearly whole, and their mean light (m, 3) over their discs."""
    found = np.flatnonzero(seen_at_centre(station_map, squares) & (sharpness(station_map, squares) > 0))
    patches, share = sample_patches(station_map, squares.only(found))
    whole = share >= LEAST_SHARE
    weight = disc_weights()[::3]
    light = LINEAR_OF_LEVEL[patches[whole].reshape(-1, PATCH_SIZE * PATCH_SIZE, 3)]
    return found[whole], (light * weight[:, None]).sum(axis=1) / weight.sum()


def _several(splat: np.ndarray) -> np.ndarray:
    """(m,) bool: rows whose splat has another row."""
    _, at, count = np.unique(splat, return_inverse=True, return_counts=True)
    return count[at] > 1
