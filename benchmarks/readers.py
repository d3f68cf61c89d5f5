"""Readers of two states of this repository, in turns: processor time to open a scan and read all its points, new / old.

    python -m benchmarks.readers OLD_TREE SCAN... [--pairs 5] [--seconds 2]

OLD_TREE is a checkout (`git worktree add OLD_TREE COMMIT`) that runs with this Python. Each reading is a process of its
own, its children counted; it reads a scan once, or once and many times more, and the difference is what a reading takes
without imports.
"""

from __future__ import annotations

import argparse
import math
import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent.parent
_READ = """
import sys
from pipeline.readers import open_scan
for _ in range(int(sys.argv[2])):
    assert sum(len(piece.position) for piece in open_scan(sys.argv[1]).pieces(1 << 18)) > 0
"""


def processor_seconds(tree: Path, scan: Path, times: int) -> float:
    """Of a process that reads a scan so many times, with all it started."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    subprocess.run([sys.executable, "-c", _READ, str(scan), str(times)], cwd=tree, env=environment, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def reading_seconds(tree: Path, scan: Path, times: int) -> float:
    """Of one reading, without what starting and importing take."""
    return (processor_seconds(tree, scan, 1 + times) - processor_seconds(tree, scan, 1)) / times


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path)
    parser.add_argument("scans", type=Path, nargs="+")
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=2.0, help="that readings of a process take about")
    args = parser.parse_args()
    for scan in args.scans:
        for tree in (args.old, HERE):
            processor_seconds(tree.resolve(), scan.resolve(), 1)  # compiles
        once = max(1e-3, reading_seconds(args.old.resolve(), scan.resolve(), 20))
        times, took = math.ceil(args.seconds / once), []
        for pair in range(args.pairs):
            trees = (args.old.resolve(), HERE)
            seconds = {tree: reading_seconds(tree, scan.resolve(), times) for tree in trees[:: -1 if pair % 2 else 1]}
            took.append((seconds[trees[0]], seconds[trees[1]]))
        old, new = np.median(took, axis=0)
        ratios = [b / a for a, b in took]
        every = ", ".join(f"{r:.2f}" for r in ratios)
        print(f"{scan.name}: {old:.3f} s, now {new:.3f}: {np.median(ratios):.2f} ({every})", flush=True)


if __name__ == "__main__":
    main()
