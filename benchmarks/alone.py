"""What one process does alone, at sizes that no machine here has the points for: on made-up results and folders.

    python -m benchmarks.alone SCAN FOLDER [--tasks 1000 10000 100000] [--groups 8000 80000 800000] [--out alone.jsonl]

SCAN is a small COLMAP workspace. It is compressed once (draft, in this process); then of every stage whose tasks grow
with the scan `init` runs again, and what these tasks told goes in so many copies, pickled and back as Dask hands it
over, to `finalise`. Besides: the scheduler and its client, by stages of tasks that do nothing; the table, directory and
seal of a packed file of so many groups, each of the bytes that a group of SCAN has; what a training set takes to look
at a splat that it does not choose; the counts of a grid's cells, merged. FOLDER takes the folders, which go at the end.
`benchmarks/fit_costs.py --alone` fits the terms of the cost model to these rows.
"""

from __future__ import annotations

import argparse
import json
import pickle
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.alone_parts import (
    nothing_to_do,
    packed_folders,
    seconds_of,
    seconds_of_cells,
    seconds_of_kinds,
    seconds_of_training,
)
from benchmarks.patches import Silent
from pipeline.catalogue import BY_NAME, Task
from pipeline.costs.probe import probe_seconds
from pipeline.execution.executors import SerialExecutor
from pipeline.execution.stage import result_type
from pipeline.planning.settings import settings_for
from pipeline.stages.points import ingest, neighbours
from pipeline.stages.points.neighbours import SpacingBlock
from pipeline.stages.points.partition import OrderedPart
from services.processes.compress import compress
from storage.work import work

BLOCKS = 64  # of a leaf
GROWING = {Task.BLOCK, Task.PART, Task.SLICE, Task.GROUP, Task.BY_PHOTO}
APART = {"pack", "grid-counts", "leaves"}  # whose `finalise` reads what tasks left: made up by alone_parts.py


@dataclass
class Remembering(SerialExecutor):
    """Runs stages, and remembers them."""

    stages: dict[str, tuple[Any, Path]]

    def run(self, stage, folder, indices, on_done) -> None:
        self.stages[stage.name] = stage, folder
        super().run(stage, folder, indices, on_done)


def compressed(scan: Path, folder: Path) -> dict[str, tuple[Any, Path]]:
    """The stages of a small job, and their folders."""
    neighbours.MOST_SPACINGS = 0  # as of a large scan, of which tasks tell some spacings
    executor = Remembering({})
    settings = settings_for("draft", effects="sizes=on,cliplines=on")
    compress(scan, folder / "out", settings, executor, Silent(), render=False, work=folder / "work")
    return executor.stages


def of_stages(stages: dict[str, tuple[Any, Path]], folder: Path, n_tasks: list[int]) -> Iterator[dict]:
    """A row for each stage and number of tasks."""
    for name, (stage, made) in stages.items():
        if BY_NAME[name].task not in GROWING or name in APART:
            continue
        told = [record.result for _, record in sorted(work.finished_tasks(made, result_type(stage)).items())]
        told = [one for one in told if one is not None]
        with tempfile.TemporaryDirectory(dir=folder) as again:
            init_s = seconds_of(_begin, stage, Path(again))
        for n in n_tasks:
            results = [_as_of(told[i % len(told)], n) for i in range(n)]
            yield {
                "kind": "stage",
                "name": name,
                "tasks": n,
                "init_s": init_s,
                "hand_over_s": seconds_of(_hand_over, results),
                "finalise_s": seconds_of(_end, stage, made, results),
            }


def _as_of(told: Any, n_tasks: int) -> Any:
    """What a task tells where there are so many: of spacings a share, of a leaf all its blocks."""
    if isinstance(told, OrderedPart):
        return replace(told, block_low=_apart(told.block_low), block_high=_apart(told.block_high))
    if isinstance(told, SpacingBlock):
        return replace(told, sample=told.sample[: max(1, neighbours.SAMPLED // n_tasks)])
    return pickle.loads(pickle.dumps(told))  # else all are one to pickle


def _apart(corners: list[list[float]]) -> list[list[float]]:
    return [[x + i for x in corners[0]] for i in range(BLOCKS)]


def _begin(stage: Any, folder: Path) -> None:
    work.begin(folder)
    stage.init(folder)


def _hand_over(results: list) -> None:
    pickle.loads(pickle.dumps(results))


def _end(stage: Any, folder: Path, results: list) -> None:
    if stage.name == "ingest":  # else it says that the file has not as many points
        ingest._merged(results)
        return
    work.write_json(folder / "again.json", stage.finalise(folder, results))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--tasks", type=int, nargs="+", default=[1000, 10_000, 100_000])
    parser.add_argument("--groups", type=int, nargs="+", default=[8_000, 80_000, 800_000], help="laid out")
    parser.add_argument("--sealed", type=int, nargs="+", default=[2_000, 16_000], help="groups put together and sealed")
    parser.add_argument("--parts", type=int, nargs="+", default=[64, 512])
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--only", choices=("dispatch", "stages", "pack", "kinds", "training", "cells"))
    parser.add_argument("--out", type=Path, help="add the rows to this file, a line each")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(dir=options.folder))
    parts: dict[str, Callable[[], Iterator[dict]]] = {
        "dispatch": lambda: nothing_to_do(folder, options.workers),
        "stages": lambda: of_stages(stages, folder, options.tasks),
        "pack": lambda: packed_folders(stages["pack"][1], folder, options.groups, options.sealed),
        "kinds": lambda: seconds_of_kinds(stages["pack"][0]),
        "training": lambda: seconds_of_training(stages["training-set"][0]),
        "cells": lambda: seconds_of_cells(folder, options.parts),
    }
    stages = {} if options.only in ("dispatch", "cells") else compressed(options.scan, folder)
    probe_s = probe_seconds()
    try:
        for name, rows in parts.items():
            if options.only in (None, name):
                for row in rows():
                    line = json.dumps(row | {"probe_s": probe_s})
                    print(line, flush=True)
                    if options.out:
                        with open(options.out, "a") as kept:
                            kept.write(line + "\n")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()
