"""Large LAZ and E57 files read by all workers: wall and processor seconds of the stage `ingest`, with one worker and
more, and of each worker and of the process that parses for it: how many processors were busy, and how many there are.

    python -m benchmarks.ingest SCAN.laz FOLDER [--points 50000000] [--workers 1 2] [--formats laz e57]

SCAN's points are taken again and again, moved and jittered, until there are so many; FOLDER takes the files (about 6
and 27 bytes a point), which go at the end, and the stage's arrays.
"""

from __future__ import annotations

import argparse
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import laspy
import numpy as np
import psutil
import pye57
from pye57 import libe57

from pipeline.execution.executors import DaskExecutor
from pipeline.execution.stage import StageRecord, run_stage
from pipeline.stages.points.ingest import Ingest
from storage.work import work

AT_ONCE = 1 << 21


def copies(scan: Path, n_points: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Positions (m, 3) float64 and colours (m, 3) uint16, so many in all."""
    read, rng = laspy.read(scan), np.random.default_rng(0)
    position = np.column_stack([read.x, read.y, read.z])
    color = np.column_stack([read.red, read.green, read.blue])
    step, at = np.ptp(position, axis=0) * [1.05, 1.05, 0], 0
    for i in range(-(-n_points // len(position))):
        n = min(len(position), n_points - at)
        moved = position[:n] + step * [i % 8, i // 8, 0] + rng.normal(0, 0.004, (n, 3))
        yield moved, color[:n]
        at += n


def write_laz(scan: Path, path: Path, n_points: int) -> None:
    header = laspy.LasHeader(point_format=2, version="1.2")
    header.scales = np.full(3, 0.001)
    with laspy.open(path, mode="w", header=header) as writer:
        for position, color in copies(scan, n_points):
            points = laspy.ScaleAwarePointRecord.zeros(len(position), header=header)
            points.x, points.y, points.z = position.T
            points.red, points.green, points.blue = color.T
            writer.write_points(points)


def write_e57(scan: Path, path: Path, n_points: int) -> None:
    file = pye57.E57(str(path), mode="w")
    image = file.image_file
    prototype = libe57.StructureNode(image)
    names = ("cartesianX", "cartesianY", "cartesianZ", "colorRed", "colorGreen", "colorBlue")
    for name in names:
        whole = name.startswith("color")
        node = (
            libe57.IntegerNode(image, 0, 0, 255)
            if whole
            else libe57.ScaledIntegerNode(image, 0, -(1 << 30), 1 << 30, 1e-4, 0.0)
        )
        prototype.set(name, node)
    one = libe57.StructureNode(image)
    one.set("guid", libe57.StringNode(image, "{made}"))
    vector = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
    one.set("points", vector)
    file.data3d.append(one)
    room = [np.empty(AT_ONCE, np.uint8 if n.startswith("color") else np.float64) for n in names]
    buffers = libe57.VectorSourceDestBuffer()
    for name, values in zip(names, room, strict=True):
        buffers.append(libe57.SourceDestBuffer(image, name, values, AT_ONCE, True, True))
    writer = vector.writer(buffers)
    for position, color in copies(scan, n_points):
        for values, column in zip(room, [*position.T, *(color >> 8).T], strict=True):
            values[: len(column)] = column
        writer.write(len(position))
    writer.close()
    file.close()


class Silent:
    """Hears how a stage comes on, and says nothing."""

    def begin(self, name: str, n_tasks: int) -> None: ...

    def advance(self, name: str, n_tasks: int, n_splats: int) -> None: ...

    def end(self, record: StageRecord) -> None: ...


def used_by_process() -> list[tuple[float, float]]:
    """Processor seconds so far of each worker of this process, and of all that it started: what parses for it."""
    found = []
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.Error):
            command = " ".join(process.cmdline())
            if "spawn_main" in command or "forkserver" in command:
                parsers = [p.cpu_times() for p in process.children(recursive=True)]
                own = process.cpu_times()
                found.append((own.user + own.system, sum(t.user + t.system for t in parsers)))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--points", type=int, default=50_000_000)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--formats", nargs="+", choices=("laz", "e57"), default=["laz", "e57"])
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    for kind in args.formats:
        path = args.folder / f"large.{kind}"
        {"laz": write_laz, "e57": write_e57}[kind](args.scan, path, args.points)
        print(f"{kind}: {args.points:,} points, {path.stat().st_size / 1e6:,.0f} MB", flush=True)
        for n_workers in args.workers:
            folder = args.folder / f"work-{n_workers}"
            with DaskExecutor(n_workers) as executor:
                before = used_by_process()
                start = time.perf_counter()
                stage = Ingest(str(path), str(n_workers))
                run_stage(stage, folder, executor, Silent())
                wall = time.perf_counter() - start
                after = used_by_process()
            tasks = work.finished_tasks(work.stage_folder(folder, stage)).values()
            used = sum(task.processor_seconds for task in tasks)
            peak = max(task.peak_rss_bytes for task in tasks) >> 20
            rate = f"{args.points / wall / 1e6:.2f} million points/s, {len(tasks)} tasks, a worker at most {peak} MiB"
            print(
                f"  {n_workers} workers: {wall:.1f} s, {used:.1f} s of tasks (without the processes that parse); {rate}",
                flush=True,
            )
            took = np.subtract(after, [*before, *[(0.0, 0.0)] * (len(after) - len(before))])
            each = ", ".join(f"{own:.1f} + {parsing:.1f} s" for own, parsing in took)
            print(
                f"    each worker + its parser: {each}; {took.sum():.1f} s, {took.sum() / wall:.2f} processors busy of "
                f"{len(os.sched_getaffinity(0))}",
                flush=True,
            )
            shutil.rmtree(folder)
        path.unlink()


if __name__ == "__main__":
    main()
