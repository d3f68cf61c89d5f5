"""Does the cost of a splat stay the same as scans grow, and do two workers do twice the work of one?

    python -m benchmarks.scaling SCAN [--coder C] [--splats 100000 400000] [--workers 1 2] [--dictionary-bits 8]
        [--effects ellipsoids=off] [--json] [--out FILE]

SCAN is a COLMAP workspace; it is thinned or made denser along its surfaces (`benchmarks/scans.py`) and compressed with
one radius, without pictures, on the photographs that it has. Seconds are those of all stages; microseconds a splat
leave out learning, whose cost the settings fix. Processor seconds are those of the tasks. --out keeps the rows for
`benchmarks/fit_costs.py`.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.patches import Silent
from benchmarks.scans import resized
from pipeline.catalogue import LEARNING
from pipeline.costs.probe import probe_seconds
from pipeline.execution.executors import DaskExecutor
from pipeline.planning.settings import settings_for
from services.processes.compress import compress
from storage.packed.packed import SUFFIX, PackedFile
from storage.work import work


def measure(
    scan: Path, n_splats: int, n_workers: int, coder: str | None, bits: int | None, effects: str, radius: float
) -> dict:
    with tempfile.TemporaryDirectory(dir=".") as folder, DaskExecutor(n_workers) as executor:
        made = resized(scan, Path(folder) / scan.name, n_splats, radius / 2)
        settings = settings_for("balanced", coder=coder, dictionary_bits=bits, effects=effects, radius=radius)
        probe_s = probe_seconds()
        report = compress(
            made, Path(folder) / "out", settings, executor, Silent(), render=False, work=Path(folder) / "work"
        )
        stages = report["stages"]
        tasks = {s["name"]: _tasks_of(Path(folder) / "work", s["name"]) for s in stages}
        with PackedFile(next((Path(folder) / "out").glob(f"*{SUFFIX}"))) as packed:
            n_indices, atom_size = packed.header.n_indices, packed.header.atom_size
    growing = sum(s["seconds"] for s in stages if s["name"] not in LEARNING)
    return {
        "scan": scan.name,
        "splats": n_splats,
        "workers": n_workers,
        "coder": settings.coder,
        "pursuit": settings.pursuit,
        "indices": n_indices,
        "atom_size": atom_size,
        "max_atoms": settings.max_atoms,
        "atoms": report["atoms"]["mean"],
        "probe_s": probe_s,
        "quality": report["quality"],
        "bytes_per_splat": report["sizes"]["bytes_per_splat"],
        "tasks": tasks,
        "seconds": {s["name"]: s["seconds"] for s in stages},
        "total_seconds": sum(s["seconds"] for s in stages),
        "processor_seconds": sum(sum(t["processor_seconds"]) for t in tasks.values()),
        "microseconds_a_splat": 1e6 * growing / n_splats,
        "peak_rss_bytes": max(s["peak_rss_bytes"] or 0 for s in stages),
    }


def _tasks_of(folder: Path, name: str) -> dict:
    """What the tasks of a stage took, of all its passes, and the bytes it left."""
    found = [
        r for stage in sorted(folder.glob(f"{name}-????????????????")) for r in work.finished_tasks(stage).values()
    ]
    files = [p for stage in folder.glob(f"{name}-????????????????") for p in stage.rglob("*") if p.is_file()]
    return {
        "seconds": [r.seconds for r in found],
        "processor_seconds": [r.processor_seconds for r in found],
        "compile_seconds": [r.compile_seconds for r in found],
        "splats": [r.n_splats for r in found],
        "peak_rss_bytes": [r.peak_rss_bytes for r in found],
        "passes": len(list(folder.glob(f"{name}-????????????????"))),
        "written_bytes": int(np.sum([p.stat().st_size for p in files])),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path)
    parser.add_argument("--splats", type=int, nargs="+", default=[100_000, 400_000])
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--coder", help="default: the preset's")
    parser.add_argument(
        "--effects",
        default="",
        metavar="NAME=CHOICE",
        help="so that every size has the same; default: what each calls for",
    )
    parser.add_argument("--dictionary-bits", type=int, choices=(8, 10, 12, 14, 16), help="default: the preset's")
    parser.add_argument(
        "--radius", type=float, default=0.0224, help="in the scan's unit; default: that of fountain_p11"
    )
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--out", type=Path, help="add the rows to this file, a line each")
    options = parser.parse_args()
    rows = []
    for n, workers in ((n, w) for n in options.splats for w in options.workers):
        rows.append(
            measure(options.scan, n, workers, options.coder, options.dictionary_bits, options.effects, options.radius)
        )
        if options.out:
            with open(options.out, "a") as kept:
                kept.write(json.dumps(rows[-1]) + "\n")
        if not options.json:
            _show(rows[-1])
    if options.json:
        print(json.dumps({"rows": rows}))


def _show(row: dict) -> None:
    print(
        f"{row['splats']:>10,} splats, {row['workers']} workers: {row['total_seconds']:7.1f} s ({row['processor_seconds']:.1f} s of "
        f"processors in tasks), {row['microseconds_a_splat']:6.1f} us a splat besides learning, "
        f"worker at most {row['peak_rss_bytes'] / 2**20:.0f} MiB"
    )


if __name__ == "__main__":
    main()
