"""Does the cost of a splat stay the same as scans grow, and do two workers do twice the work of one?

    python -m benchmarks.scaling [--splats 100000 400000] [--workers 1 2] [--dictionary-bits 8] [--json]

Compresses the synthetic terrain of benchmarks/memory.py with every size and number of workers, without pictures.
Seconds are those of all stages; microseconds a splat leave out learning, whose cost the settings fix.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

from benchmarks.memory import Silent, write_terrain
from pipeline.executors import DaskExecutor
from pipeline.settings import settings_for
from services.workflow import compress

LEARNING = ("training-set", "components", "dictionary-seed", "ksvd-update", "quantise")


def measure(n_splats: int, n_workers: int, bits: int) -> dict:
    with tempfile.TemporaryDirectory() as folder, DaskExecutor(n_workers) as executor:
        scan = write_terrain(Path(folder) / "terrain", n_splats)
        settings = settings_for("balanced", dictionary_bits=bits)
        stages = compress(scan, Path(folder) / "out", settings, executor, Silent(), render=False)["stages"]
    growing = sum(s["seconds"] for s in stages if s["name"] not in LEARNING)
    return {"splats": n_splats, "workers": n_workers, "dictionary_bits": bits,
            "seconds": {s["name"]: s["seconds"] for s in stages}, "total_seconds": sum(s["seconds"] for s in stages),
            "microseconds_a_splat": 1e6 * growing / n_splats,
            "peak_rss_bytes": max(s["peak_rss_bytes"] or 0 for s in stages)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--splats", type=int, nargs="+", default=[100_000, 400_000])
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--dictionary-bits", type=int, default=8, choices=(8, 12, 16))
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = [measure(n, w, options.dictionary_bits) for n in options.splats for w in options.workers]
    if options.json:
        print(json.dumps({"rows": rows}))
        return
    for row in rows:
        print(f"{row['splats']:>10,} splats, {row['workers']} workers: {row['total_seconds']:7.1f} s, "
              f"{row['microseconds_a_splat']:6.1f} us a splat besides learning, "
              f"worker at most {row['peak_rss_bytes'] / 2**20:.0f} MiB")


if __name__ == "__main__":
    main()
