"""A laser scan of several stations against photographs that made no colour of it, and against what its other stations
saw."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.execution.executors import SerialExecutor
from pipeline.maps.light import levels_with
from pipeline.maps.sample import Squares, seen_at_centre
from pipeline.maps.station_map import StationMap
from pipeline.readers.detect import open_scan
from pipeline.splats.sizes import needed_sizes
from pipeline.stages.maps.panoramas import read_map
from pipeline.stages.points.neighbours import Neighbourhoods
from pipeline.summaries import Points
from renderer.pictures import resized
from renderer.splats.views import view_of
from services.cli.commands.running import progress_bars
from services.flow.points.read import in_chunk_order
from services.flow.prepare import prepare
from services.flow.run import Run
from storage.packed.schema import Camera
from storage.work import arrays, work

# Scans made of a scene of photographs by a virtual scanner: the workspace beside them, and photographs that it did not
# take colours from.
HELD_OUT = {"fountain_3stations.e57": ("../fountain_p11", ("0003.jpg", "0007.jpg"))}
WIDTH_PX = 768
WRONG_LEVELS = 40  # of 255, of the channel that is off most
EVERY = 8  # points of a station


@dataclass(frozen=True)
class OtherStation:
    """Points of one station looked up in another's map, in one light. Shares of these points."""

    of: int
    by: int
    apart: float  # between the stations, in the scan's unit
    wrong_untested: float  # another colour, whatever the distance
    seen: float  # the map has their surface, by the depth test
    wrong: float  # another colour, of those seen


def held_out_photographs(scan: Path) -> Iterator[tuple[Camera, np.ndarray]]:
    """Cameras, and their photographs (h, w, 3) uint8, of a scan that HELD_OUT knows; of others none."""
    if scan.name not in HELD_OUT:
        return
    beside, names = HELD_OUT[scan.name]
    source = open_scan(scan.parent / beside)
    assert source.read_photo is not None
    for i, camera in enumerate(source.cameras):
        if camera.name in names:
            view = view_of(camera, (WIDTH_PX, round(WIDTH_PX * camera.height_px / camera.width_px)))
            yield view, resized(source.read_photo(i), view.width_px, view.height_px)


def other_stations(scan: Path, work_folder: Path) -> list[OtherStation]:
    """All pairs of stations of a scan; the maps are those that `compress --density 0.1` draws."""
    with SerialExecutor() as executor:
        run = Run(work_folder, executor, progress_bars())
        prepared = prepare(run, scan, None, "station_maps=on", density=0.1)
        maps = prepared.maps
        if maps is None or len(maps.log_gain) < 2:
            return []
        partition = in_chunk_order(run, prepared.scan, 1.0)
        neighbours = run.do(Neighbourhoods(partition.folder))
    origin = np.array(work.summary(partition.folder, Points).origin)
    n = partition.summary.n_splats
    rows = np.arange(0, n, EVERY)
    position = arrays.read(partition.folder, "position", 0, n)[rows]
    station = arrays.read(partition.folder, "station", 0, n)[rows]
    color = arrays.read(partition.folder, "color", 0, n)[rows]
    normal = arrays.read(neighbours.folder, "normal", 0, n)[rows].astype(float)
    spacing = arrays.read(neighbours.folder, "spacing", 0, n)[rows].astype(float)
    radius = needed_sizes(position, spacing, 0.0)
    found = []
    for of in range(len(maps.log_gain)):
        for by in range(len(maps.log_gain)):
            station_map = read_map(maps.folder, by)
            if of == by or station_map is None:
                continue
            some = station == of
            local = position[some] + origin - station_map.frame.centre
            squares = Squares(local, *_tangents(normal[some]), radius[some])
            own = levels_with(maps.log_gain[of])[color[some], np.arange(3)]
            theirs = levels_with(maps.log_gain[by])[_texels(station_map, squares), np.arange(3)]
            off = np.abs(own.astype(float) - theirs).max(axis=1) > WRONG_LEVELS
            seen = seen_at_centre(station_map, squares)
            centres = [np.array(prepared.scan.summary.stations[i]) for i in (of, by)]
            apart = float(np.linalg.norm(centres[0] - centres[1]))
            found.append(OtherStation(of, by, apart, *map(float, (off.mean(), seen.mean(), off[seen].mean()))))
    return found


def _tangents(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Any two at right angles to unit normals (n, 3) and to each other."""
    u = np.cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return u, np.cross(normal, u)


def _texels(station_map: StationMap, squares: Squares) -> np.ndarray:
    """The colours (n, 3) uint8 of the texels that centres fall into."""
    projection = station_map.frame.projection
    pixels, _ = projection.project(squares.centre + np.asarray(projection.centre))
    column, row = np.minimum(pixels.astype(int), np.array(projection.size) - 1).T
    return station_map.color[row, column, :3]
