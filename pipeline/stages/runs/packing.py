"""Codes of runs, brick by brick, as the groups of the packed file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.stages.runs.found import CellsFilled
from storage.packed.runs.tables import lengths_of
from storage.work import arrays, work

NAMES = ("run_base", "run_first", "run_start", "run_normal", "run_step")


def runs_of_group(codes: Path, cells: Path, start: int, stop: int) -> dict[str, np.ndarray]:
    """The arrays of the runs of cells start..stop, a group's, counted from its first."""
    first = work.summary(cells, CellsFilled).first_cell
    parts: dict[str, list[np.ndarray]] = {name: [] for name in NAMES}
    n_runs = 0
    for brick in range(len(first) - 1):
        if first[brick] >= stop or first[brick + 1] <= start or first[brick] == first[brick + 1]:
            continue
        found = {name: arrays.read(codes, f"{name}_{brick}") for name in NAMES}
        begin = first[brick] + np.concatenate([[0], np.cumsum(lengths_of(found["run_start"]))])
        r0, r1 = np.searchsorted(begin[:-1], [start, stop]).tolist()
        s0, s1 = np.searchsorted(found["run_first"], [r0, r1]).tolist()
        t0, t1 = (int(begin[r] - first[brick] - r) for r in (r0, r1))
        parts["run_base"].append(found["run_base"][s0:s1])
        parts["run_first"].append((found["run_first"][s0:s1].astype(np.int64) - r0 + n_runs).astype(np.uint32))
        for name, rows in (("run_start", slice(r0, r1)), ("run_normal", slice(r0, r1)), ("run_step", slice(t0, t1))):
            parts[name].append(found[name][rows])
        n_runs += r1 - r0
    return {name: np.concatenate(rows) for name, rows in parts.items()}
