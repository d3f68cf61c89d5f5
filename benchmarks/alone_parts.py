"""Made-up folders for `benchmarks/alone.py`: what one process does with what as many tasks left as no scan here has."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.patches import Silent
from pipeline.execution import executors
from pipeline.execution.executors import DaskExecutor
from pipeline.execution.stage import run_stage
from pipeline.geometry.cells import Grid
from pipeline.geometry.leaves import grow_leaves
from pipeline.stages.packed.kinds import batches_of
from pipeline.stages.packed.pack import Pack
from pipeline.stages.points import grid_counts, leaves
from pipeline.stages.texture.training import TrainingSet
from pipeline.summaries import AverageColors, Counted, LeavesGrown
from storage.packed.layout import ROOT_MEMBER
from storage.packed.schema import GROUP, Header, arrays_of
from storage.packed.writing.joined import begin_file, end_file, lay_out, seal_packed, write_range
from storage.packed.writing.writer import PIECES, begin_packed, groups_a_piece, n_pieces, piece_of, told_file, told_of
from storage.work import arrays, work

ROUNDS = 3
SLABS, CELLS_A_PART, LEAVES_A_PART = 1 << 10, 1 << 15, 1 << 9  # of a grid of 10 billion points, and their parts


@dataclass(frozen=True)
class Nothing:
    """Tasks that do nothing."""

    n_tasks: int
    a_call: int
    name = "nothing"

    def init(self, folder: Path) -> int:
        return self.n_tasks

    def run(self, folder: Path, index: int) -> Counted:
        return Counted(1)

    def finalise(self, folder: Path, results: list[Counted]) -> Counted:
        return Counted(len(results))


def nothing_to_do(folder: Path, n_workers: int) -> Iterator[dict]:
    """Seconds of the client's process, in which a local cluster's scheduler runs too, and seconds in all, by tasks a
    call."""
    usual = executors.MOST_A_CALL
    with DaskExecutor(n_workers) as executor:
        run_stage(Nothing(100, 0), folder, executor, Silent())
        for a_call, n_tasks in ((1, 1), (1, 1), (1, 1), (1, 1000), (1, 4000), (8, 8000), (32, 16_000)):
            executors.MOST_A_CALL = a_call
            n_calls = len(executors.calls_of(n_tasks, n_workers))
            begun, processor = time.perf_counter(), time.process_time()
            record = run_stage(Nothing(n_tasks, a_call), folder, executor, Silent())
            work.discard(record.folder)
            yield {
                "kind": "dispatch",
                "tasks": n_tasks,
                "calls": n_calls,
                "workers": n_workers,
                "processor_s": time.process_time() - processor,
                "seconds": time.perf_counter() - begun,
            }
    executors.MOST_A_CALL = usual


def packed_folders(made: Path, folder: Path, n_groups: list[int], n_sealed: list[int]) -> Iterator[dict]:
    """Seconds to lay out so many groups, which takes what tasks told alone, and to put together and seal some of them.
    `made` is a folder of the stage `pack`, of whose first piece all others are copies: bytes are those of real groups,
    names in them are not."""
    header = Header.from_json(json.loads((made / "packed" / ROOT_MEMBER).read_bytes())["attributes"])
    told = np.frombuffer(told_file(made / "packed", 0).read_bytes(), told_of(header))
    whole = told[np.argmax(told["bytes"])]
    content = piece_of(made / "packed", 0).read_bytes()
    at = int(told["bytes"][: np.argmax(told["bytes"])].sum())
    group = content[at : at + int(whole["bytes"])]
    for n in sorted({*n_groups, *n_sealed}):
        pack, large = folder / "packed", replace(header, n_splats=n * GROUP)
        begin_s = seconds_of(begin_packed, pack, large)
        for array in arrays_of(large):
            if array.part == "dictionary":
                shutil.copytree(made / "packed" / array.name, pack / array.name, dirs_exist_ok=True)
        (pack / PIECES).mkdir()
        step = groups_a_piece(large)
        for piece in range(n_pieces(large)):
            here = min(step, n - piece * step)
            told_file(pack, piece).write_bytes(np.repeat(whole, here).tobytes())
            if n in n_sealed:
                piece_of(pack, piece).write_bytes(group * here)
        row = {"kind": "pack", "splats": n * GROUP, "pieces": n_pieces(large), "init_s": begin_s}
        row["lay_out_s"] = seconds_of(lay_out, pack, large)
        if n in n_sealed:
            row["bytes"] = begin_file(pack, folder / "a")
            row["written_s"] = seconds_of(write_range, pack, folder / "a", 0, row["bytes"])
            row["digest_s"] = seconds_of(end_file, folder / "a")
            row["seal_s"] = seconds_of(seal_packed, pack, folder / "b")
        yield row
        shutil.rmtree(pack)


def seconds_of_kinds(pack: Pack) -> Iterator[dict]:
    """Seconds to look through the kinds of splats, which the process that asks does of a small scan."""
    n = pack.header.n_splats
    yield {"kind": "kinds", "splats": n, "seconds": seconds_of(batches_of, n, pack.codes, pack.extras)}


def seconds_of_training(training: TrainingSet) -> Iterator[dict]:
    """Seconds to look at splats, of which hardly any is chosen."""
    n = arrays.layout_of(training.colors, "energy").shape[0]
    share = np.full(len(work.summary(training.colors, AverageColors).census), 1e-6)
    yield {"kind": "training", "splats": n, "seconds": seconds_of(training._look, share, 0, n)}


def seconds_of_cells(folder: Path, n_parts: list[int]) -> Iterator[dict]:
    """Seconds of the end of `grid-counts`, to merge the counts of parts, to grow leaves and to read the counts again,
    and of that of `leaves`. Each part has CELLS_A_PART cells in a row of a surface of SLABS squared, as a scanner's turn
    sweeps some of it, and so many leaves."""
    rng, grid = np.random.default_rng(0), Grid(np.tile(np.linspace(0, 1, SLABS + 1)[1:-1], (3, 1)))
    x, y = rng.integers(0, SLABS, (2, SLABS * SLABS))
    cells = np.unique(((x << 20) | (y << 10) | ((x + y) >> 1)).astype(np.int32))
    for n in n_parts:
        paths, runs = [folder / f"cells-{i}.npz" for i in range(n)], folder / f"leaves-{n}"
        work.begin(runs)
        for i, path in enumerate(paths):
            at = int(rng.integers(0, len(cells) - CELLS_A_PART))
            work.write_parts(path, cell=cells[at : at + CELLS_A_PART], count=np.full(CELLS_A_PART, 64, np.int64))
            leaf = np.sort(rng.choice(n * LEAVES_A_PART, LEAVES_A_PART, replace=False))
            work.write_parts(leaves._runs_of(runs, i), leaf=leaf, begin=leaf, count=leaf)
        work.write_json(runs / "summary.json", {"seconds": 0.0, "summary": LeavesGrown(0, n * LEAVES_A_PART)})
        counts = grid_counts._merged(paths)
        grown = grow_leaves(counts, grid, np.zeros(3), np.ones(3), int(counts.count.sum()) // max(1, n))
        yield {
            "kind": "cells",
            "parts": n,
            "cells": len(counts.cell),
            "leaves": grown.n_leaves,
            "divided": len(grown.divided),
            "merge_s": seconds_of(grid_counts._merged, paths),
            "grow_s": seconds_of(grow_leaves, counts, grid, np.zeros(3), np.ones(3), int(counts.count.sum()) // n),
            "before_s": seconds_of(grid_counts.before_parts, paths, grown.divided),
            "runs_s": seconds_of(leaves.DealtLeaves(runs, runs).finalise, runs, [Counted(1)] * n),
        }


def seconds_of(do: Callable[..., Any], *arguments: Any) -> float:
    """The median of some rounds."""
    took = []
    for _ in range(ROUNDS):
        begun = time.perf_counter()
        do(*arguments)
        took.append(time.perf_counter() - begun)
    return float(np.median(took))
