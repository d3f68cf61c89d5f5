"""Runs of cells in a packed file: which belong to a group of splats, and whether their tables fit each other.

A group of GROUP splats is whole sections, a section whole runs, so that a group is decoded from its own alone. Cells
stand run by run; the splats of a chunk are its cells, sorted by batch as those of any file.
"""

from __future__ import annotations

import numpy as np

from storage.packed.schema import (
    CHUNK,
    COLUMN_BITS,
    GROUP,
    LENGTH_BITS,
    MOST_RUNS,
    ROW_BITS,
    SLICE_BITS,
    Array,
    Header,
)

MOST_INDEX = 1 << 20  # of a cell along an axis, either way: its centre is a whole number that float32 holds
N_TURNS = 6

# What `run_codes` of a file holds, of q sections, m runs and t steps, as a graphics card takes it: in memory alone.
DECODED = (
    Array("run_base", ("q", "3"), "int32", "geometry", "column, row, slice that each section's starts count from"),
    Array("run_first", ("q",), "uint32", "geometry", "first run of each section"),
    Array("run_start", ("m",), "uint32", "geometry", "11 bits of column, 11 of row, 5 of slice, 5 of length - 1"),
    Array("run_normal", ("m", "2"), "int8", "geometry", "octahedral normal of each run's first cell, -127..127"),
    Array("run_step", ("t",), "uint8", "geometry", "turn, 3 bits, and step of the normal, 5, of each further cell"),
)

# Of a cell that is a run and a section of its own: 43 bits by models, which take no more than 9 each, and 90 others are
# 60 bytes.
_MOST_BYTES_A_CELL, _ENDING = 64, 4


def most_bytes(n_cells: int) -> int:
    """What the codes of so many cells take no more than (storage/packed/runs/coded.py)."""
    return _ENDING + _MOST_BYTES_A_CELL * n_cells


def lengths_of(start: np.ndarray) -> np.ndarray:
    """Cells of each run, (m,) int64."""
    return (start >> np.uint32(32 - LENGTH_BITS)).astype(np.int64) + 1


def cell_order(run_batch: np.ndarray | None, n: int) -> np.ndarray:
    """The cell of each splat, (n,) int64, of whole chunks: by batch within a chunk, then as they stand in runs."""
    if run_batch is None:
        return np.arange(n)
    return np.lexsort((run_batch, np.arange(n) // CHUNK))


def joined_tables(n_sections: np.ndarray, n_runs: np.ndarray, first: np.ndarray) -> dict[str, np.ndarray]:
    """`run_first` and `run_section` of consecutive groups of so many sections and runs (g,) each, of what theirs say
    alone (q,)."""
    before = np.cumsum(n_runs) - n_runs
    return {
        "run_first": (first + np.repeat(before, n_sections)).astype(np.uint32),
        "run_section": (np.cumsum(n_sections) - n_sections).astype(np.uint32),
    }


def run_bounds(header: Header, arrays: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Low and high corner (3,) float64 against the origin of a box that holds all cells of a group's runs: a run leaves
    its first cell by no more columns and rows than it has cells, and never its slice. Not the smallest such box."""
    assert header.runs is not None
    start, first = arrays["run_start"], arrays["run_first"].astype(np.int64)
    section = np.searchsorted(first, np.arange(len(start)), side="right") - 1
    bits = COLUMN_BITS, ROW_BITS, SLICE_BITS
    shifts = 0, COLUMN_BITS, COLUMN_BITS + ROW_BITS
    field = np.stack([start >> np.uint32(at) & np.uint32(2**n - 1) for at, n in zip(shifts, bits)], axis=1)
    column, row, layer = (arrays["run_base"][section].astype(np.float64) + field).T
    reach = lengths_of(start)
    low = np.stack([2 * (column - reach), 3 * (row - reach), layer], axis=1)
    high = np.stack([2 * (column + reach) + 1, 3 * (row + reach) + 1, layer], axis=1)
    pitch = header.runs.cell * np.array([1 / 2, np.sqrt(3) / 6, np.sqrt(2 / 3)])
    slack = 1e-6 * header.runs.cell * (1 + np.abs(low).max())  # positions are in float32
    low, high = low.min(axis=0) * pitch - slack, high.max(axis=0) * pitch + slack
    turn = np.array(header.runs.turn).reshape(3, 3)
    middle, half = turn @ ((low + high) / 2), np.abs(turn) @ ((high - low) / 2)
    return middle - half, middle + half


def check_runs(header: Header, arrays: dict[str, np.ndarray]) -> None:
    """ValueError unless the tables fit each other, so that no decoder leaves an array, or the whole numbers of
    float32."""
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
