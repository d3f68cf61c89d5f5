"""Station maps -> which of them textures each splat, and the splat's mean colour: what stands for it where its map
shows another surface, and in whatever draws no maps."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.maps.choice import NO_STATION
from pipeline.maps.light import levels_with
from pipeline.maps.sample import sample_patches
from pipeline.stages.maps.resample_maps import LEAST_SHARE, Gains, MappedSplats
from pipeline.summaries import MapsDrawn
from pipeline.texture.resample import PATCH_DIM, disc_weights
from storage.maps import IN_PART, NO_MAP
from storage.work import arrays, work

# Of a splat that a map must show, that it is looked up from aside: where surfaces are smaller than splats, as leaves
# are, what a station saw in them is not what another eye does. conference_room, a tenth, away of near 1, against one
# colour a splat: -1.9 and -1.3 dB with all looked up from everywhere, 0.0 and +0.5 without those below 0.4, +0.2 and
# +0.4 without those below 0.7; of pump_e57, where surfaces are large, +1.7 on average, +1.6 and +1.0.
WHOLE_SHARE = 0.4
# And of all splats, those of which it shows less that call for it: 7.4 % of conference_room, whose plants they are, 0.2 %
# of fountain_3stations, where they are what large splats reach over, and looking up costs 0.9 dB to leave out.
CALLED_FOR_FROM = 0.01
ROWS = 1024  # splats at a time: their patches take 3 MB


@dataclass(frozen=True)
class StationsChosen:
    """Of the map that textures each splat."""

    n_blind: int  # splats that no map shows
    n_in_part: int  # of which one shows less than WHOLE_SHARE
    n_splats: int

    @property
    def front_alone(self) -> bool:
        """Whether these are looked up from the front alone."""
        return self.n_in_part >= CALLED_FOR_FROM * self.n_splats


@dataclass(frozen=True)
class StationsBlock:
    """What a task tells of its block."""

    n_splats: int
    n_blind: int
    n_in_part: int


@dataclass(frozen=True)
class StationOfSplats:
    """A task a block. Arrays: station (n,) uint8, numbers of stations with maps in their order, NO_MAP where no map
    shows the splat, and IN_PART more where it shows less than WHOLE_SHARE of it; as `Colors` takes them average (n, 3)
    float32, and energy (n,) float32, 0: nothing is coded."""

    of: MappedSplats
    log_gain: Gains
    name = "mapped-splats"

    def init(self, folder: Path) -> int:
        n = self.of.n_splats
        arrays.create(folder, "station", (n,), "uint8")
        arrays.create(folder, "average", (n, 3), "float32")
        arrays.create(folder, "energy", (n,), "float32")
        return arrays.n_blocks(n)

    def run(self, folder: Path, index: int) -> StationsBlock:
        start, stop = arrays.block_range(index, self.of.n_splats)
        splats = self.of.block(start, stop)
        average = arrays.read(self.of.splats, "color", start, stop).astype(np.float32)
        station = np.full(stop - start, NO_MAP, np.uint8)
        has_map = [frame is not None for frame in work.summary(self.of.maps, MapsDrawn).frames]
        best = splats.best_stations()
        for i in np.unique(best[best != NO_STATION]):
            station_map, rows = self.of.map_of(int(i)), np.flatnonzero(best == i)
            squares, levels = splats.squares(station_map), levels_with(self.log_gain[i])
            for at in range(0, len(rows), ROWS):
                some = rows[at : at + ROWS]
                patches, shown = sample_patches(station_map, squares.only(some), levels)
                seen = shown >= LEAST_SHARE
                station[some[seen]] = sum(has_map[:i])
                station[some[seen & (shown < WHOLE_SHARE)]] += np.uint8(IN_PART)
                average[some[seen]] = _means(patches[seen])
        arrays.write(folder, "station", start, station)
        arrays.write(folder, "average", start, average)
        arrays.write(folder, "energy", start, np.zeros(stop - start, np.float32))
        is_blind = station == NO_MAP
        return StationsBlock(stop - start, int(is_blind.sum()), int(((station >= IN_PART) & ~is_blind).sum()))

    def finalise(self, folder: Path, results: list[StationsBlock]) -> StationsChosen:
        return StationsChosen(*(sum(getattr(r, k) for r in results) for k in ("n_blind", "n_in_part", "n_splats")))


def stations_in_file(folder: Path, start: int, stop: int) -> np.ndarray:
    """Stations of these splats, (stop - start,) uint8, with IN_PART only in a scan that calls for it."""
    station = arrays.read(folder, "station", start, stop)
    if work.summary(folder, StationsChosen).front_alone:
        return station
    return np.where(station == NO_MAP, station, station % np.uint8(IN_PART)).astype(np.uint8)


def _means(patches: np.ndarray) -> np.ndarray:
    """Mean colours (n, 3) float32 of patches (n, s, s, 3) over their discs."""
    weight = disc_weights().reshape(-1, 3)[:, 0]
    rows = patches.reshape(len(patches), PATCH_DIM // 3, 3).astype(np.float64)
    return (np.einsum("nkc,k->nc", rows, weight) / weight.sum()).astype(np.float32)
