"""Station maps -> patches: each splat's square in the map of the station that shows it best."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from pipeline.geometry.frame import Direction
from pipeline.maps.choice import NO_STATION, best_stations
from pipeline.maps.light import levels_with
from pipeline.maps.sample import Squares, sample_patches, texels_spanned
from pipeline.maps.station_map import StationMap
from pipeline.splats.decoded import decoded_squares
from pipeline.stages.maps.panoramas import read_map
from pipeline.summaries import Counted, MapsDrawn, PatchesMade, Points
from pipeline.texture.patches import measured
from pipeline.texture.resample import PATCH_DIM
from storage.packed.schema import PATCH_SIZE
from storage.work import arrays, work

LEAST_SHARE = 0.02  # of a patch that a map must show: 20 of 1,024 texels
Gains = tuple[tuple[float, float, float], ...]


@dataclass(frozen=True)
class MappedSplats:
    """Splats of a scan and the maps of its stations, as they look at each other."""

    maps: Path  # as those of `Panoramas`
    partition: Path
    splats: Path
    radius: float
    up: Direction
    ahead: Direction

    @property
    def n_splats(self) -> int:
        return work.summary(self.splats, Counted).n_splats

    @property
    def n_stations(self) -> int:
        return len(work.summary(self.maps, MapsDrawn).frames)

    def map_of(self, station: int) -> StationMap | None:
        return read_map(self.maps, station)

    def block(self, start: int, stop: int) -> MappedBlock:
        """Those of whole chunks."""
        return MappedBlock(self, start, stop)


@dataclass(frozen=True)
class MappedBlock:
    """Splats start..stop."""

    of: MappedSplats
    start: int
    stop: int

    @property
    def own(self) -> np.ndarray:  # (n,) int64
        if not arrays.exists(self.of.partition, "station"):
            return np.full(self.stop - self.start, NO_STATION)
        return arrays.read(self.of.partition, "station", self.start, self.stop).astype(np.int64)

    def squares(self, station_map: StationMap) -> Squares:
        """All of them, against the map's station."""
        centre, (u, v), radii = self._decoded
        offset = np.array(work.summary(self.of.partition, Points).origin) - np.array(station_map.frame.centre)
        return Squares(centre + offset, u, v, radii)

    def best_stations(self) -> np.ndarray:
        """(n,): the station whose map shows each splat best, NO_STATION where none does."""
        return best_stations(self.of.map_of, self.of.n_stations, self.squares, self.own)

    @cached_property
    def _decoded(self) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray], np.ndarray]:
        s = self.of
        return decoded_squares(s.splats, s.up, s.ahead, s.radius, self.start, self.stop)


@dataclass(frozen=True)
class BlockFromMaps:
    """What a task tells of its block."""

    n_splats: int
    n_flagged: int
    n_blind: int
    n_other_station: int
    energy: float
    log_texels: float  # sum of logarithms of the texels that splats with a map span


@dataclass(frozen=True)
class ResampleMaps:
    """A task a block. Arrays as those of `Resample`: texel, average, energy, point."""

    of: MappedSplats
    log_gain: Gains  # of each station's light, by channel
    name = "resample-maps"

    def init(self, folder: Path) -> int:
        n = self.of.n_splats
        arrays.create(folder, "texel", (n, PATCH_DIM), "uint8")
        arrays.create(folder, "average", (n, 3), "float32")
        arrays.create(folder, "energy", (n,), "float32")
        arrays.create(folder, "point", (n,), "uint32")
        return arrays.n_blocks(n)

    def run(self, folder: Path, index: int) -> BlockFromMaps:
        start, stop = arrays.block_range(index, self.of.n_splats)
        splats = self.of.block(start, stop)
        texel = np.empty((stop - start, PATCH_DIM), np.uint8)
        shown, log_texels = np.zeros(stop - start), 0.0
        best = splats.best_stations()
        for station in np.unique(best[best != NO_STATION]):
            station_map, rows = self.of.map_of(int(station)), np.flatnonzero(best == station)
            levels = levels_with(self.log_gain[station])
            squares = splats.squares(station_map).only(rows)
            patches, shown[rows] = sample_patches(station_map, squares, levels)
            log_texels += float(np.log(texels_spanned(squares, station_map.frame.projection.step)).sum())
            texel[rows] = patches.reshape(len(rows), PATCH_DIM)
        blind = shown < LEAST_SHARE
        color = arrays.read(self.of.splats, "color", start, stop)[blind]
        texel[blind] = np.tile(color, PATCH_SIZE * PATCH_SIZE)
        average, energy = measured(texel)
        for name, rows in (("texel", texel), ("average", average), ("energy", energy)):  # type: ignore[assignment]
            arrays.write(folder, name, start, rows)
        arrays.write(folder, "point", start, arrays.read(self.of.partition, "point", start, stop))
        return BlockFromMaps(
            n_splats=stop - start,
            n_flagged=int((shown < 1).sum()),
            n_blind=int(blind.sum()),
            n_other_station=int(((best != splats.own) & ~blind).sum()),
            energy=float(energy.sum(dtype=np.float64)),
            log_texels=log_texels,
        )

    def finalise(self, folder: Path, results: list[BlockFromMaps]) -> PatchesMade:
        sums = {k: sum(getattr(r, k) for r in results) for k in ("energy", "n_flagged", "n_blind", "n_other_station")}
        n = sum(r.n_splats for r in results) or 1
        return PatchesMade(**sums, map_texels=math.exp(sum(r.log_texels for r in results) / n))
