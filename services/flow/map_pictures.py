"""`map`: what each station of a laser scan saw, as pictures to look at and to edit."""

from __future__ import annotations

import shutil
from pathlib import Path

from pipeline.execution.stage import Executor, Progress
from pipeline.maps.files import write_map
from pipeline.readers.attributes.options import ReadOptions
from pipeline.stages.maps.panoramas import read_map
from pipeline.stages.points.neighbours import Neighbourhoods
from services.flow.maps import draw_maps
from services.flow.points.read import points_of
from services.flow.run import Run
from storage.errors import InvalidScan
from storage.whole import placed_whole


def map_scan(
    scan: Path,
    out: Path,
    executor: Executor,
    progress: Progress,
    *,
    reading: ReadOptions = ReadOptions(),
    work: Path | None = None,
) -> list[dict]:
    """Draw the maps of a scan's stations into the folder `out`, which appears with all of them or not at all.

    Returns a row a station: its number, centre, step in degrees, share of directions that show a surface, and files;
    None in place of these for a station that saw nothing.

    Raises: InvalidScan for a scan without stations.
    """
    with placed_whole(out) as made:
        run = Run(work or made / "work", executor, progress)
        ingest, partition = points_of(run, scan, reading=reading)
        if not ingest.summary.stations:
            raise InvalidScan(
                str(scan), "no station: nothing says where a scanner stood", "a laser scan with stations",
                "--station x,y,z says where the scanner of a merged scan stood",
            )  # fmt: skip
        maps = draw_maps(run, ingest, partition, run.do(Neighbourhoods(partition.folder))).folder
        rows = [_row(maps, i, made, ingest.summary.unit) for i in range(len(ingest.summary.stations))]
        if work is None:
            shutil.rmtree(made / "work")
    return rows


def _row(maps: Path, index: int, folder: Path, unit: str) -> dict:
    station_map = read_map(maps, index)
    if station_map is None:
        return {"station": index, "centre": None, "step_degrees": None, "covered": None, "files": []}
    return {
        "station": index,
        "centre": list(station_map.frame.centre),
        "step_degrees": 90 / station_map.frame.height_px,
        "covered": float((station_map.color[..., 3] > 0).mean()),
        "files": write_map(folder, station_map, unit),
    }
