"""Processor microseconds a point of `neighbours` and `ellipsoids`, and their ratio: points without photographs.

    python -m benchmarks.points_alone SCAN... [--repeat 3] [--profile]

Each scan is compressed once, with ellipsoids on; then all tasks of both stages run again in this process, in turns.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from pipeline.effects.ellipsoids.stage import Ellipsoids
from pipeline.execution.stage import Stage
from pipeline.stages.points.neighbours import Neighbourhoods
from pipeline.summaries import Points, Spacings
from storage.work import arrays, work


def stages_of(scan: Path, folder: Path) -> tuple[Stage, Stage, int]:
    """Both stages as `scan` has them, and its splats; the noise is that of the planes of a half radius of tolerance at
    most."""
    command = [sys.executable, "-m", "services.cli.main", "compress", str(scan), "--effect", "ellipsoids=on"]
    options = ["--no-render", "--executor", "serial", "--work", str(folder / "work"), "--out", str(folder / "out")]
    subprocess.run([*command, *options], check=True, capture_output=True)
    (partition,) = (folder / "work").glob("partition-*")
    (spacing,) = (folder / "work").glob("neighbours-*")
    (measured,) = (folder / "work").glob("measure-effects-*")
    noise = work.read_json(measured / "summary.json")["summary"]["ellipsoids"]["outcome"]["noise_radii"]
    sizes = [s for s in (folder / "work").glob("splats-*") if arrays.exists(s, "size_code")]
    radius = work.summary(spacing, Spacings).median_spacing
    ellipsoids = Ellipsoids(partition, radius, noise, sizes[0] if sizes else None)
    return Neighbourhoods(partition), ellipsoids, work.summary(partition, Points).n_splats


def seconds_of(stage: Stage) -> float:
    """Processor seconds of all tasks of a stage, in this process."""
    with tempfile.TemporaryDirectory() as folder:
        n_tasks = stage.init(Path(folder))
        start = time.process_time()
        for index in range(n_tasks):
            stage.run(Path(folder), index)
        return time.process_time() - start


def print_profile(stage: Stage, n: int) -> None:
    """Where the time of a stage goes, by file: the functions themselves, without those that they call."""
    profile = cProfile.Profile()
    profile.enable()
    seconds_of(stage)
    profile.disable()
    took: dict[str, float] = {}
    stats: dict = pstats.Stats(profile).stats  # type: ignore[attr-defined]
    for (file, _, _), (_, _, own, _, _) in stats.items():
        took[Path(file).name] = took.get(Path(file).name, 0.0) + own
    for file, seconds in sorted(took.items(), key=lambda one: -one[1])[:10]:
        print(f"    {file:24} {seconds / sum(took.values()):6.1%} {1e6 * seconds / n:6.2f} us a point")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", type=Path, nargs="+")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--profile", action="store_true", help="where the time of ellipsoids goes, by file")
    args = parser.parse_args()
    for scan in args.scans:
        with tempfile.TemporaryDirectory() as folder:
            neighbours, ellipsoids, n = stages_of(scan, Path(folder))
            for stage in (neighbours, ellipsoids):
                seconds_of(stage)  # compiles
            took = np.array([(seconds_of(neighbours), seconds_of(ellipsoids)) for _ in range(args.repeat)])
            one, other = 1e6 * np.median(took, axis=0) / n
            ratio = np.median(took[:, 1] / took[:, 0])
            print(f"{scan.name}: {n:,} points; us a point: neighbours {one:.2f}, ellipsoids {other:.2f}; {ratio:.2f}")
            if args.profile:
                print_profile(ellipsoids, n)


if __name__ == "__main__":
    main()
