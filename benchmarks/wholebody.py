"""A volume as large as the paper's Wholebody, made by tiling: seconds, processor seconds and memory of its surface in runs.

    python -m benchmarks.wholebody VOLUME.nrrd ISO --work FOLDER [--slices 3172 793] [--workers 2] [--json]

512 x 512 voxels a slice. DuoDecim (2006), Table 2, takes 1.7 hours of one core for its Wholebody, 512 x 512 x 3172. `processor_s` is of all
processes, reading and writing with them; `stages` has seconds, then of their tasks the number, processor seconds, bytes left and MiB; on a machine that others use, half of that is what two cores of one's own would take.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import time
from pathlib import Path

import numpy as np

from benchmarks.patches import Silent
from pipeline.execution.executors import DaskExecutor
from pipeline.planning.settings import settings_for
from pipeline.volumes.open import open_volume
from services.processes.compress import compress
from storage.packed.packed import SUFFIX
from storage.work import work

SIDE = 512


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("volume", type=Path)
    parser.add_argument("iso")
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--slices", type=int, nargs="+", default=[793, 3172])
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = [measured(options.volume, options.iso, options.work, n, options.workers) for n in options.slices]
    print(json.dumps(rows) if options.json else "\n\n".join(map(_text, rows)))


def measured(volume: Path, iso: str, folder: Path, n_slices: int, n_workers: int) -> dict:
    tiled = tile(volume, folder / f"tiled_{n_slices}.nrrd", n_slices)
    stages, out = folder / f"work_{n_slices}", folder / f"out_{n_slices}"
    before, begun = _processor_s(), time.perf_counter()
    with DaskExecutor(n_workers) as executor:
        settings = settings_for("draft", iso=iso, geometry="runs")
        report = compress(tiled, out, settings, executor, Silent(), render=False, work=stages)
    wall = time.perf_counter() - begun
    file_bytes = next(out.glob(f"*{SUFFIX}")).stat().st_size
    used = {s["name"]: _used(stages, s["name"]) for s in report["stages"]}
    for path in (stages, out):
        shutil.rmtree(path)
    tiled.unlink()
    return {
        "slices": n_slices, "workers": n_workers, "cells": report["splats"], "wall_s": wall, "processor_s": _processor_s() - before,
        "peak_mib": max(s["peak_rss_bytes"] or 0 for s in report["stages"]) / 2**20, "file_bytes": file_bytes,
        "bits": report["runs"]["bits"], "disk_bits": report["runs"]["disk_bits"], "efficiency": report["runs"]["efficiency"],
        "stages": {s["name"]: [round(s["seconds"], 1), *used[s["name"]]] for s in report["stages"]},
    }  # fmt: skip


def _used(folder: Path, name: str) -> list[float]:
    """Of a stage's tasks: how many, their processor seconds without compiling, bytes on disk, MiB of the largest."""
    found = sorted(folder.glob(f"{name}-????????????????"))
    tasks = [task for stage in found for task in work.finished_tasks(stage).values()]
    n_bytes = sum(p.stat().st_size for stage in found for p in stage.rglob("*") if p.is_file())
    seconds = sum(max(0.0, task.processor_seconds - task.compile_seconds) for task in tasks)
    return [len(tasks), round(seconds, 2), n_bytes, round(max((t.peak_rss_bytes for t in tasks), default=0) / 2**20)]


def _processor_s() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used)


def tile(volume: Path, path: Path, n_slices: int) -> Path:
    """A raw NRRD of the volume's voxels, again and again along every axis."""
    found = np.stack(list(open_volume(volume).slices(lambda text: None)))
    assert found.dtype == np.uint8
    times = (-(-SIDE // found.shape[1]), -(-SIDE // found.shape[2]))
    wide = np.tile(found, (1, *times))[:, :SIDE, :SIDE]
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "wb") as file:
        file.write(f"NRRD0004\ntype: uint8\ndimension: 3\nsizes: {SIDE} {SIDE} {n_slices}\nencoding: raw\n\n".encode())
        for k in range(n_slices):
            file.write(np.ascontiguousarray(wide[k % len(wide)]).tobytes())
    return path


def _text(row: dict) -> str:
    return "\n".join(f"{name:<12} {value}" for name, value in row.items())


if __name__ == "__main__":
    main()
