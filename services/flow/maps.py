"""Maps of a laser scan's stations, drawn from all of its points, whatever share of them became splats."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipeline.execution.stage import StageRecord
from pipeline.stages.maps.edited_maps import EditedMaps
from pipeline.stages.maps.map_pictures import MapPictures, PicturesMade
from pipeline.stages.maps.mapped_splats import StationOfSplats, StationsChosen
from pipeline.stages.maps.panoramas import Panoramas
from pipeline.stages.maps.resample_maps import MappedSplats
from pipeline.stages.maps.station_light import StationGains, StationLight
from pipeline.stages.texture.colors import Colors
from pipeline.summaries import AverageColors, MapsDrawn
from services.flow.fingerprint import fingerprint
from services.flow.run import Run
from storage.errors import InvalidScan
from storage.maps import MOST_MAPS


@dataclass(frozen=True)
class StationMaps:
    """Where splats are textured from in place of photographs."""

    folder: Path  # color_<i> and depth_<i> of each station
    log_gain: tuple[tuple[float, float, float], ...]  # of each station's light, by channel
    light: StationGains | None  # what the gains were told from; None for one station


@dataclass(frozen=True)
class Mapped:
    """Maps as the packed file holds them, and which of them each splat has."""

    pictures: StageRecord[PicturesMade]
    stations: StageRecord[StationsChosen]
    colors: StageRecord[AverageColors]  # mean colours of splats, as the file has them

    @property
    def texture_psnr_db(self) -> float | None:
        """Of the colours of maps, over what shows a surface."""
        return self.pictures.summary.texture_psnr_db


def draw_maps(run: Run, ingest: StageRecord, partition: StageRecord, neighbours: StageRecord) -> StageRecord[MapsDrawn]:
    """The maps of all stations; `partition` and `neighbours` have all points of the scan."""
    return run.do(Panoramas(ingest.folder, partition.folder, neighbours.folder))


def with_edits(run: Run, maps: Path, edited: Path | None) -> Path:
    """The folder of maps, with the pictures of `edited` in place of those that were drawn."""
    if edited is None:
        return maps
    if not edited.is_dir():
        raise FileNotFoundError(f"{edited}: no such folder of maps")
    return run.do(EditedMaps(maps, str(edited.resolve()), fingerprint(edited))).folder


def maps_for(run: Run, splats: MappedSplats) -> StationMaps:
    """Maps as texture: the light of several stations brought together."""
    if splats.n_stations < 2:
        return StationMaps(splats.maps, ((0.0, 0.0, 0.0),) * splats.n_stations, None)
    light = run.do(StationLight(splats)).summary
    return StationMaps(splats.maps, light.log_gain, light)


def map_pictures(run: Run, maps: StationMaps, target_psnr_db: float) -> StageRecord[PicturesMade]:
    """The maps' pictures as the packed file would hold them, as sharp as the target asks."""
    return run.do(MapPictures(maps.folder, maps.log_gain, target_psnr_db))


def map_textures(
    run: Run, maps: StationMaps, splats: MappedSplats, pictures: StageRecord[PicturesMade], color_step: int
) -> Mapped:
    """The maps themselves as texture; mean colours in boxes of cells of this code.

    Raises: InvalidScan for more stations than a packed file has numbers for.
    """
    if len(maps.log_gain) > MOST_MAPS:
        raise InvalidScan("texture", f"maps of {len(maps.log_gain)} stations", f"at most {MOST_MAPS}", "take atoms")
    stations = run.do(StationOfSplats(splats, maps.log_gain))
    return Mapped(pictures, stations, run.do(Colors(stations.folder, color_step)))
