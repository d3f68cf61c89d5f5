"""Does the memory of a worker grow with the stations of a laser scan?

    python -m benchmarks.station_memory [--stations 1 2 4 8] [--step-degrees 0.25] [--json]

A made room is scanned from so many stations, each a sector of its surroundings, so that all make the same number of
points and each a map of the same size. It is compressed by two workers with maps in the file and with atoms of maps, at
a tenth of the points. Printed is, stage by stage, the peak resident memory of the worker that needed most; pages of
files that a worker has mapped count as its own.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.memory import Silent
from pipeline.execution.executors import DaskExecutor
from pipeline.planning.settings import settings_for
from services.processes.compress import compress
from tests.stations import Seen, scanned, write_e57

OF_MAPS = ("panoramas", "station-light", "map-cliplines", "map-pictures", "mapped-splats", "resample-maps")


def sector(seen: Seen, index: int, n_sectors: int) -> Seen:
    """What a station saw in one of equal sectors of its azimuth."""
    x, y = (seen.position - seen.centre)[:, :2].T
    rows = (np.arctan2(y, x) / (2 * np.pi) % 1 * n_sectors).astype(int) % n_sectors == index
    return replace(seen, position=seen.position[rows], normal=seen.normal[rows], color=seen.color[rows])


def peaks_of(n_stations: int, step_degrees: float) -> dict[str, int]:
    """Bytes by stage."""
    places = np.random.default_rng(0).uniform((-2.5, -2.0, -0.5), (0.6, 2.0, 0.5), (n_stations, 3))
    peaks: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as name, DaskExecutor(2) as executor:
        seen = [sector(scanned(place, step_degrees), i, n_stations) for i, place in enumerate(places)]
        scan = write_e57(Path(name) / "room.e57", *seen)
        for texture in ("map", "atoms"):
            settings = settings_for("draft", density=0.1, texture=texture)
            out, work = Path(name) / texture, Path(name) / "work"
            report = compress(scan, out, settings, executor, Silent(), render=False, work=work)
            for stage in report["stages"]:
                if not stage["reused"]:
                    peaks[stage["name"]] = max(peaks.get(stage["name"], 0), stage["peak_rss_bytes"] or 0)
    return peaks


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stations", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--step-degrees", type=float, default=0.25)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    peaks = {n: peaks_of(n, options.step_degrees) for n in options.stations}
    if options.json:
        print(json.dumps(peaks))
        return
    print(f"{'MiB of a worker':18}" + "".join(f"{n:>5} stations" for n in peaks))
    for stage in [*peaks[max(peaks)], "all"]:
        found = [max(of.values()) if stage == "all" else of.get(stage, 0) for of in peaks.values()]
        mark = " of maps" if stage in OF_MAPS else ""
        print(f"{stage:18}" + "".join(f"{n / 2**20:14.0f}" if n else f"{'-':>14}" for n in found) + mark, flush=True)


if __name__ == "__main__":
    main()
