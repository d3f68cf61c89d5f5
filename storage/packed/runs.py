"""Runs of cells in a packed file: which belong to a group of splats, and whether their tables fit each other.

A group of GROUP splats is whole sections, a section whole runs, so that a group is decoded from its own alone. Cells stand run by
run; the splats of a chunk are its cells, sorted by batch as those of any file.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from storage.packed.schema import CHUNK, GROUP, LENGTH_BITS, MOST_RUNS, Header

MOST_INDEX = 1 << 20  # of a cell along an axis, either way: its centre is a whole number that float32 holds
N_TURNS = 6
BY_SECTION, BY_RUN = ("run_base", "run_first"), ("run_start", "run_normal")


def lengths_of(start: np.ndarray) -> np.ndarray:
    """Cells of each run, (m,) int64."""
    return (start >> np.uint32(32 - LENGTH_BITS)).astype(np.int64) + 1


def cell_order(run_batch: np.ndarray | None, n: int) -> np.ndarray:
    """The cell of each splat, (n,) int64, of whole chunks: by batch within a chunk, then as they stand in runs."""
    if run_batch is None:
        return np.arange(n)
    return np.lexsort((run_batch, np.arange(n) // CHUNK))


def read_group(read: Callable[..., np.ndarray], header: Header, index: int) -> tuple[dict[str, np.ndarray], Header]:
    """The arrays of runs of one group, counted from it, and the header of the group alone. `read(name, start, stop)` reads rows.

    Raises: ValueError where the group's tables name rows that are not there.
    """
    assert header.runs is not None
    first, end = _span(read("run_section", index, index + 2), header.runs.n_sections)
    section = {name: read(name, first, end) for name in BY_SECTION}
    first_run, end_run = _span(
        np.concatenate([section["run_first"][:1], read("run_first", end, end + 1)]), header.runs.n_runs
    )
    found = section | {name: read(name, first_run, end_run) for name in BY_RUN}
    found["run_first"] = found["run_first"] - np.uint32(first_run)
    first_step, n = index * GROUP - first_run, min(GROUP, header.n_splats - index * GROUP)
    if first_step < 0 or n < end_run - first_run:
        raise ValueError(f"run_first does not fit group {index}")
    found["run_step"] = read("run_step", first_step, first_step + n - (end_run - first_run))
    found["run_section"], found["run_codebook"] = np.zeros(1, np.uint32), read("run_codebook")
    grid = replace(header.runs, n_sections=end - first, n_runs=end_run - first_run)
    return found, replace(header, n_splats=n, runs=grid)


def _span(table: np.ndarray, n: int) -> tuple[int, int]:
    """First and end by a table's entry and the next, which is `n` where there is none."""
    first, end = int(table[0]), int(table[1]) if len(table) > 1 else n
    if not first < end <= n:
        raise ValueError(f"a table of runs says {first} to {end} of {n}")
    return first, end


def check_runs(header: Header, arrays: dict[str, np.ndarray]) -> None:
    """ValueError unless the tables fit each other, so that no decoder leaves an array, or the whole numbers of float32."""
    assert header.runs is not None
    length, first = lengths_of(arrays["run_start"]), arrays["run_first"].astype(np.int64)
    sections = arrays["run_section"].astype(np.int64)
    if length.sum() != header.n_splats:
        raise ValueError(f"runs of {length.sum()} cells for {header.n_splats} splats")
    if not (_ascend(first, header.runs.n_runs, MOST_RUNS) and _ascend(sections, header.runs.n_sections, GROUP)):
        raise ValueError(f"run_first or run_section does not ascend from 0, by at most {MOST_RUNS} runs a section")
    of_group = np.add.reduceat(length, first[sections])
    if not (of_group == np.minimum(GROUP, header.n_splats - GROUP * np.arange(header.n_groups))).all():
        raise ValueError("run_start and run_section do not add up to the size of every group")
    if np.abs(arrays["run_base"].astype(np.int64)).max() > MOST_INDEX:
        raise ValueError(f"run_base beyond {MOST_INDEX}")
    if len(arrays["run_step"]) and (arrays["run_step"] & 7).max() >= N_TURNS:
        raise ValueError(f"run_step has the turn {(arrays['run_step'] & 7).max()}, not 0..{N_TURNS - 1}")
    if "run_batch" in arrays:
        _check_batches(header, arrays["run_batch"], arrays["batch_count"])


def _ascend(table: np.ndarray, n: int, most: int) -> bool:
    step = np.diff(table, append=n)
    return table[0] == 0 and step.min() > 0 and step.max() <= most


def _check_batches(header: Header, batch: np.ndarray, counts: np.ndarray) -> None:
    n = len(header.batches)
    if batch.max() >= n:
        raise ValueError(f"run_batch has {batch.max()}, not 0..{n - 1}")
    flat = np.bincount(np.arange(len(batch)) // CHUNK * n + batch, minlength=header.n_chunks * n)
    if not (flat.reshape(-1, n) == counts).all():
        raise ValueError("run_batch does not fit batch_count")
