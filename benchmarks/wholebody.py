"""A volume as large as the paper's Wholebody, made by tiling: seconds, processor seconds and memory of a whole `compress` of its surface.

    python -m benchmarks.wholebody VOLUME.nrrd ISO --work FOLDER [--slices 793 3172] [--geometry runs] [--workers 2] [--json]

512 x 512 voxels a slice, all knobs but the geometry as `compress` has them, with previews and report. DuoDecim (2006), Table 2, takes 1.7 hours of one
core for its Wholebody, 512 x 512 x 3172. `wall_s` begins with the start of the workers and ends with the last file; `tiling_s` is not in it.
`processor_s` is of all processes, reading and writing with them: on a machine that others use, half of that is what two cores of one's own would
take. `stages` has seconds, then of their tasks the number, processor seconds, bytes left and MiB. `leader_mib` is the most that the
process which leads and draws has held, of the largest job up to then.
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
from pipeline.planning.settings import DEFAULT_PRESET, PRESETS, Settings, settings_for
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
    parser.add_argument("--geometry", choices=("auto", "boxes", "runs"), default="runs")
    parser.add_argument("--preset", choices=tuple(PRESETS), default=DEFAULT_PRESET)
    parser.add_argument("--no-previews", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    asked = {"iso": options.iso, "geometry": options.geometry}
    settings = settings_for(options.preset, **asked)
    rows = [
        measured(options.volume, options.work, n, settings, options.workers, not options.no_previews)
        for n in options.slices
    ]
    print(json.dumps(rows) if options.json else "\n\n".join(map(_text, rows)))


def measured(volume: Path, folder: Path, n_slices: int, settings: Settings, n_workers: int, previews: bool) -> dict:
    begun = time.perf_counter()
    tiled = tile(volume, folder / f"tiled_{n_slices}.nrrd", n_slices)
    tiling = time.perf_counter() - begun
    stages, out = folder / f"work_{n_slices}", folder / f"out_{n_slices}"
    before, begun = _processor_s(), time.perf_counter()
    with DaskExecutor(n_workers) as executor:
        report = compress(tiled, out, settings, executor, Silent(), render=previews, work=stages)
    wall = time.perf_counter() - begun
    file_bytes = next(out.glob(f"*{SUFFIX}")).stat().st_size
    used = {s["name"]: _used(stages, s["name"]) for s in report["stages"]}
    for path in (stages, out):
        shutil.rmtree(path)
    tiled.unlink()
    runs = report.get("runs") or {}
    return {
        "slices": n_slices, "workers": n_workers, "preset": settings.preset, "geometry": settings.geometry, "splats": report["splats"],
        "tiling_s": tiling, "wall_s": wall, "processor_s": _processor_s() - before,
        "peak_mib": max(s["peak_rss_bytes"] or 0 for s in report["stages"]) / 2**20,
        "leader_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10, "file_bytes": file_bytes,
        **{name: runs.get(name) for name in ("bits", "disk_bits", "efficiency")},
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
