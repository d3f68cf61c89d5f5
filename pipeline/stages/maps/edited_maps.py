"""Maps whose pictures somebody edited, in place of those that were drawn."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from pipeline.maps.files import COLOR, has_map, name_of, read_edited
from pipeline.stages.maps.panoramas import read_map
from pipeline.summaries import MapsDrawn
from storage.errors import InvalidScan
from storage.work import arrays, work


@dataclass(frozen=True)
class MapEdited:
    """What a task tells of its station."""

    edited: bool


@dataclass(frozen=True)
class EditedMaps:
    """A task a station. Arrays and summary as those of `Panoramas`; a station without a picture in `edited` keeps its
    map.

    Raises: InvalidScan where no station has one.
    """

    maps: Path
    edited: str  # the folder that `splatpress map` wrote, and somebody edited
    fingerprint: str  # changes when its files do
    name = "edited-maps"
    location_fields = ("edited",)

    def init(self, folder: Path) -> int:
        n_stations = len(work.summary(self.maps, MapsDrawn).frames)
        if not any(has_map(Path(self.edited), i) for i in range(n_stations)):
            wanted = f"{name_of(0)}{COLOR}" + (f" to {name_of(n_stations - 1)}{COLOR}" if n_stations > 1 else "")
            raise InvalidScan(self.edited, "no map of any station", wanted, "`splatpress map` writes them")
        return n_stations

    def run(self, folder: Path, index: int) -> MapEdited:
        made = read_map(self.maps, index)
        is_edited = made is not None and has_map(Path(self.edited), index)
        if made is None:
            return MapEdited(edited=False)
        if is_edited:
            made = read_edited(Path(self.edited), made)
        arrays.store(folder, f"color_{index}", made.color, made.color.shape)
        arrays.store(folder, f"depth_{index}", made.depth, made.depth.shape)
        return MapEdited(edited=is_edited)

    def finalise(self, folder: Path, results: list[MapEdited]) -> MapsDrawn:
        return replace(work.summary(self.maps, MapsDrawn), n_edited=sum(r.edited for r in results))
