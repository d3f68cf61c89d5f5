"""Two states of this repository on the same scans, in turns: seconds by stage, and how many times faster the newer is.

    python -m benchmarks.against OLD_TREE SCAN... [--pairs 3] [--workers 2] [--options "--levels 1"]

OLD_TREE is a checkout (`git worktree add OLD_TREE COMMIT`) that runs with this Python. `--options` are the newer's
alone: what it has by default and the older lacks can be turned off. `--reading` prints only stages that read points and
put them in order. Seconds are wall seconds of stages as their work folders say, processor seconds those of tasks, with
what a process takes to load its kernels.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent.parent
READING = ("ingest", "grid-counts", "leaves", "partition")


@dataclass(frozen=True)
class Run:
    """What one `compress` took: in all, and wall and processor seconds by stage."""

    seconds: float
    wall: dict[str, float]
    processor: dict[str, float]

    def reading(self, kind: str) -> float:
        took = getattr(self, kind)
        return sum(took.get(name, 0.0) for name in READING)


def compressed(tree: Path, scan: Path, workers: int, options: list[str]) -> Run:
    with tempfile.TemporaryDirectory() as folder:
        work, out = Path(folder) / "work", Path(folder) / "out"
        command = [
            sys.executable,
            "-m",
            "services.cli",
            "compress",
            str(scan),
            "--no-render",
            "--workers",
            str(workers),
        ]
        start = time.perf_counter()
        done = subprocess.run(
            [*command, "--work", str(work), "--out", str(out), *options],
            cwd=tree,
            env={**os.environ, "PYTHONPATH": str(tree)},
            capture_output=True,
            text=True,
        )
        seconds = time.perf_counter() - start
        if done.returncode:
            raise SystemExit(f"{tree}: compress {scan} ended with {done.returncode}: {done.stderr[-400:]}")
        wall: dict[str, float] = {}
        processor: dict[str, float] = {}
        for summary in sorted(work.glob("*/summary.json")):
            name = summary.parent.name.rsplit("-", 1)[0]
            wall[name] = wall.get(name, 0.0) + json.loads(summary.read_text())["seconds"]
            for result in (summary.parent / "results").glob("*.json"):
                task = json.loads(result.read_text())
                processor[name] = processor.get(name, 0.0) + task["processor_seconds"]
        return Run(seconds, wall, processor)


def print_stages(old: list[Run], new: list[Run]) -> None:
    names = sorted({name for run in (*old, *new) for name in run.wall})
    print(f"  {'':18}{'old':>16}{'new':>16}   wall seconds (processor)")
    for name in names:
        cells = [
            f"{np.median([r.wall.get(name, 0) for r in runs]):8.2f} ({np.median([r.processor.get(name, 0) for r in runs]):5.2f})"
            for runs in (old, new)
        ]
        print(f"  {name:18}{cells[0]:>16}{cells[1]:>16}")
    for title, of in (("all stages, wall", "wall"), ("all tasks, processor", "processor")):
        ratios = [sum(getattr(a, of).values()) / sum(getattr(b, of).values()) for a, b in zip(old, new, strict=True)]
        print(f"  {title}: {np.median(ratios):.2f} times faster ({', '.join(f'{r:.2f}' for r in ratios)})")
    ratios = [a.seconds / b.seconds for a, b in zip(old, new, strict=True)]
    print(f"  whole command: {np.median(ratios):.2f} times faster ({', '.join(f'{r:.2f}' for r in ratios)})")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path)
    parser.add_argument("scans", type=Path, nargs="+")
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--options", default="", help="of the newer alone")
    parser.add_argument("--both", default="", help="options of both")
    parser.add_argument("--reading", action="store_true", help="readers: new / old by processor seconds")
    args = parser.parse_args()
    both, newer = shlex.split(args.both), shlex.split(args.options)
    for scan in args.scans:
        old, new = [], []
        for pair in range(args.pairs):
            for tree, runs, options in sorted(
                ((args.old.resolve(), old, both), (HERE, new, both + newer)),
                key=lambda one: one[1] is new,
                reverse=pair % 2 > 0,
            ):
                runs.append(compressed(tree, scan.resolve(), args.workers, options))
        print(f"{scan.name}: {args.pairs} pairs", flush=True)
        if args.reading:
            for of in ("processor", "wall"):
                ratios = [b.reading(of) / a.reading(of) for a, b in zip(old, new, strict=True)]
                took = np.median([a.reading(of) for a in old]), np.median([b.reading(of) for b in new])
                print(
                    f"  reading, {of}: {took[0]:.2f} s, now {took[1]:.2f}: {np.median(ratios):.2f} of before {np.round(ratios, 2)}"
                )
        else:
            print_stages(old, new)


if __name__ == "__main__":
    main()
