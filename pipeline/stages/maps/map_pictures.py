"""Station maps -> pictures as the packed file holds them, in one light."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path

from pipeline.maps.light import levels_with
from pipeline.maps.stored import encode_map
from pipeline.numerics.accuracy import psnr_db
from pipeline.stages.maps.panoramas import read_map
from pipeline.stages.maps.resample_maps import Gains
from pipeline.summaries import MapsDrawn
from storage.maps import StoredMap
from storage.work import arrays, work

NAMES = ("map_colors", "map_depth_low", "map_depth_high")


@dataclass(frozen=True)
class PicturesMade:
    """Of maps as the packed file holds them; None for a station that saw nothing."""

    stored: tuple[StoredMap | None, ...]
    qualities: tuple[int | None, ...]  # of WebP
    color_bytes: int
    depth_bytes: int  # about
    texture_psnr_db: float | None  # of colours, where there is a surface


@dataclass(frozen=True)
class PictureMade:
    """What a task tells of its station; nothing stored where it saw nothing."""

    stored: StoredMap | None
    depth_bytes: int
    error: float  # squared, of all values
    n_values: int
    quality: int | None


@dataclass(frozen=True)
class MapPictures:
    """A task a station. Arrays map_colors_<i> (bytes of a WebP), map_depth_low_<i>, map_depth_high_<i> (h, 6 h) uint8;
    the summary has each one's `StoredMap` (None for a station that saw nothing), and of all the bytes of colours, about
    those that depths will take on disk (zlib's, in place of zarr's zstd), and PSNR."""

    maps: Path  # as those of `Panoramas`
    log_gain: Gains  # of each station's light, by channel
    target_psnr_db: float
    name = "map-pictures"

    def init(self, folder: Path) -> int:
        return len(work.summary(self.maps, MapsDrawn).frames)

    def run(self, folder: Path, index: int) -> PictureMade:
        station_map = read_map(self.maps, index)
        if station_map is None:
            return PictureMade(stored=None, depth_bytes=0, error=0.0, n_values=0, quality=None)
        made = encode_map(station_map, levels_with(self.log_gain[index]), self.target_psnr_db)
        for name, values in zip(NAMES, (made.color, made.depth_low, made.depth_high), strict=True):
            arrays.store(folder, f"{name}_{index}", values, values.shape)
        return PictureMade(
            stored=made.stored,
            depth_bytes=sum(len(zlib.compress(d.tobytes(), 6)) for d in (made.depth_low, made.depth_high)),
            error=made.squared_error,
            n_values=made.n_values,
            quality=made.quality,
        )

    def finalise(self, folder: Path, results: list[PictureMade]) -> PicturesMade:
        stored = tuple(r.stored for r in results)
        return PicturesMade(
            stored=stored,
            qualities=tuple(r.quality for r in results),
            color_bytes=sum(s.color_bytes for s in stored if s),
            depth_bytes=sum(r.depth_bytes for r in results),
            texture_psnr_db=psnr_db(sum(r.error for r in results), sum(r.n_values for r in results)),
        )


def stored_maps(folder: Path) -> tuple[list[int], tuple[StoredMap, ...]]:
    """The stations that have a map, and their maps as the header names them."""
    stored = work.summary(folder, PicturesMade).stored
    return [i for i, each in enumerate(stored) if each], tuple(each for each in stored if each)
