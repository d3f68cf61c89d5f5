"""Large LAZ, PLY and E57 files read and put in order by all workers: wall seconds of `ingest`, `grid-counts`, `leaves`
and `partition`, with one worker and more, in pairs one after the other, and how many processors were busy in each.

    python -m benchmarks.ingest SCAN.laz FOLDER [--points 20000000] [--workers 1 2] [--formats laz ply e57] [--pairs 1]

SCAN's points are taken again and again, moved and jittered, until there are so many; FOLDER takes the files (about 6,
15 and 27 bytes a point), which go at the end, and the stages' arrays.
"""

from __future__ import annotations

import argparse
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import suppress
from itertools import product
from pathlib import Path

import laspy
import numpy as np
import psutil
import pye57
from pye57 import libe57

from pipeline.execution.executors import DaskExecutor
from pipeline.execution.stage import Stage, StageRecord, run_stage
from pipeline.stages.points.grid_counts import GridCounts
from pipeline.stages.points.ingest import Ingest
from pipeline.stages.points.leaves import DealtLeaves
from pipeline.stages.points.partition import Partition
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


def write_ply(scan: Path, path: Path, n_points: int) -> None:
    row = np.dtype([*((axis, "<f4") for axis in "xyz"), *((name, "u1") for name in ("red", "green", "blue"))])
    types = {"<f4": "float", "|u1": "uchar"}
    properties = "".join(f"property {types[row[name].str]} {name}\n" for name in row.names)
    with path.open("wb") as file:
        file.write(
            f"ply\nformat binary_little_endian 1.0\nelement vertex {n_points}\n{properties}end_header\n".encode()
        )
        first = None
        for position, color in copies(scan, n_points):
            first = position[0] if first is None else first
            rows = np.empty(len(position), row)
            for name, column in zip(row.names, [*(position - first).T, *(color >> 8).T], strict=True):
                rows[name] = column
            rows.tofile(file)


WRITERS = {"laz": write_laz, "ply": write_ply, "e57": write_e57}


class Silent:
    """Hears how a stage comes on, and says nothing."""

    def begin(self, name: str, n_tasks: int) -> None: ...

    def advance(self, name: str, n_tasks: int, n_splats: int) -> None: ...

    def end(self, record: StageRecord) -> None: ...


def used_by_workers() -> float:
    """Processor seconds so far of the workers of this process, and of all that they started: what parses for them."""
    used = 0.0
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.Error):
            times = process.cpu_times()
            used += times.user + times.system
    return used


def in_order(scan: Path, folder: Path, n_workers: int) -> tuple[dict[str, float], float, int]:
    """Wall seconds of each stage; processors busy; and of the workers the most memory, bytes."""
    with DaskExecutor(n_workers) as executor:
        seconds, peak = {}, 0

        def done(stage: Stage) -> Path:
            nonlocal peak
            start = time.perf_counter()
            run_stage(stage, folder, executor, Silent())
            seconds[stage.name] = time.perf_counter() - start
            tasks = work.finished_tasks(made := work.stage_folder(folder, stage)).values()
            peak = max(peak, *(task.peak_rss_bytes for task in tasks))
            return made

        before = used_by_workers()
        ingest = done(Ingest(str(scan), str(n_workers)))
        counts = done(GridCounts(ingest))
        done(Partition(ingest, None, counts, done(DealtLeaves(ingest, counts))))
        used = used_by_workers() - before
    shutil.rmtree(folder)
    return seconds, used / sum(seconds.values()), peak


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--points", type=int, default=20_000_000)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--formats", nargs="+", choices=tuple(WRITERS), default=list(WRITERS))
    parser.add_argument("--pairs", type=int, default=1)
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    for kind in args.formats:
        path = args.folder / f"large.{kind}"
        WRITERS[kind](args.scan, path, args.points)
        print(f"{kind}: {args.points:,} points, {path.stat().st_size / 1e6:,.0f} MB", flush=True)
        totals = np.empty((args.pairs, len(args.workers)))
        for pair, (column, n_workers) in product(range(args.pairs), enumerate(args.workers)):
            seconds, busy, peak = in_order(path, args.folder / "work", n_workers)
            totals[pair, column] = total = sum(seconds.values())
            each = ", ".join(f"{name} {s:.1f} s" for name, s in seconds.items())
            rest = f"{busy:.2f} of {len(os.sched_getaffinity(0))} processors busy, a worker at most {peak >> 20} MiB"
            print(f"  {n_workers} workers: {total:.1f} s ({each}); {rest}", flush=True)
        faster = np.median(totals[:, :1] / totals, axis=0)
        print(
            f"  as fast as {args.workers[0]}: "
            + ", ".join(f"{n} workers {x:.2f}" for n, x in zip(args.workers, faster, strict=True))
        )
        path.unlink()


if __name__ == "__main__":
    main()
