"""Runs of a group in few bytes, and back: what a packed file holds of them.

DuoDecim (2006), section 2.5, keeps codes as the graphics card takes them and packs them by zip. Here each field goes
through adaptive models under a range coder: a turn by the two turns before, a step of the normal by the step before, a
start by the start before. All models begin anew in every group, so that one is read alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from storage.packed.runs.range_coder import (
    EVEN,
    SIGNED,
    begin_reading,
    begin_writing,
    compiled,
    end_writing,
    read_bit,
    read_even,
    read_signed,
    read_tree,
    write_bit,
    write_even,
    write_signed,
    write_tree,
)
from storage.packed.runs.tables import MOST_INDEX, most_bytes
from storage.packed.schema import COLUMN_BITS, LENGTH_BITS, MOST_RUNS, ROW_BITS, SLICE_BITS

BASE_BITS = 22  # of a base's column, row or slice, plus MOST_INDEX
RUNS_BITS = 8  # of a section's runs, less 1
NEAR = 3  # sizes of a row's change that a column is told apart by: 0, 1, 2 and more

# Where the models of each field begin, by what they depend on; a tree of b bits has 2^b places.
_TURN = 0  # two turns before
_STEP = _TURN + 64 * 8  # the step before
_BASE = _STEP + 32 * 32  # the axis
_LENGTH = _BASE + 4
_SLICE = _LENGTH + 32
_ROW = _SLICE + 32  # whether the slice is that before
_COLUMN = _ROW + 2 * SIGNED  # another slice, or how far the row is off
_A = _COLUMN + (1 + NEAR) * SIGNED
_B = _A + 256  # the highest 3 bits of a
N_MODELS = _B + 8 * 256


@dataclass(frozen=True)
class GroupRuns:
    """The runs of a group as the graphics card takes them."""

    base: np.ndarray  # (q, 3) int32
    first: np.ndarray  # (q,) uint32: the first run of each section, of the group's
    start: np.ndarray  # (m,) uint32
    normal: np.ndarray  # (m, 2) int8
    step: np.ndarray  # (n_cells - m,) uint8


@compiled
def _write(base, first, start, normal, step, out):
    models, state = np.full(N_MODELS, EVEN, np.int64), begin_writing()
    at, n_sections = 0, len(first)
    base_before = np.zeros(3, np.int64)
    column_before, row_before, slice_before = 0, 0, 0
    for section in range(n_sections):
        for axis in range(3):
            changes = 1 if base[section, axis] != base_before[axis] else 0
            write_bit(state, out, models, _BASE + axis, changes)
            if changes:
                write_even(state, out, base[section, axis] + MOST_INDEX, BASE_BITS)
                base_before[axis] = base[section, axis]
        end = first[section + 1] if section + 1 < n_sections else len(start)
        write_even(state, out, end - first[section] - 1, RUNS_BITS)
        for run in range(first[section], end):
            word, length = start[run], (start[run] >> (32 - LENGTH_BITS)) + 1
            column, row = word & ((1 << COLUMN_BITS) - 1), (word >> COLUMN_BITS) & ((1 << ROW_BITS) - 1)
            slice_ = (word >> (COLUMN_BITS + ROW_BITS)) & ((1 << SLICE_BITS) - 1)
            write_tree(state, out, models, _LENGTH, length - 1, LENGTH_BITS)
            write_tree(state, out, models, _SLICE, (slice_ - slice_before) & ((1 << SLICE_BITS) - 1), SLICE_BITS)
            same = 1 if slice_ == slice_before else 0
            write_signed(state, out, models, _ROW + SIGNED * same, row - row_before)
            near = same * (1 + min(NEAR - 1, abs(row - row_before)))
            write_signed(state, out, models, _COLUMN + SIGNED * near, column - column_before)
            column_before, row_before, slice_before = column, row, slice_
            a = normal[run, 0] & 255
            write_tree(state, out, models, _A, a, 8)
            write_tree(state, out, models, _B + 256 * (a >> 5), normal[run, 1] & 255, 8)
            turns, step_before = 0, 0
            for _ in range(length - 1):
                turn, to = step[at] & 7, step[at] >> 3
                write_tree(state, out, models, _TURN + 8 * turns, turn, 3)
                write_tree(state, out, models, _STEP + 32 * step_before, to, 5)
                turns, step_before = ((turns << 3) | turn) & 63, to
                at += 1
    return end_writing(state, out)


@compiled
def _read(data, n_cells, base, first, start, normal, step):
    """Sections and runs found; none where runs have other cells, or took other bytes, than there are."""
    models, state = np.full(N_MODELS, EVEN, np.int64), begin_reading(data)
    at, n_runs, n_sections = 0, 0, 0
    base_before = np.zeros(3, np.int64)
    column_before, row_before, slice_before = 0, 0, 0
    while n_runs + at < n_cells:
        for axis in range(3):
            if read_bit(state, data, models, _BASE + axis):
                base_before[axis] = read_even(state, data, BASE_BITS) - MOST_INDEX
            base[n_sections, axis] = base_before[axis]
        first[n_sections] = n_runs
        n_sections += 1
        for _ in range(read_even(state, data, RUNS_BITS) + 1):
            length = read_tree(state, data, models, _LENGTH, LENGTH_BITS) + 1
            if n_runs + at + length > n_cells:
                return 0, 0
            slice_ = (slice_before + read_tree(state, data, models, _SLICE, SLICE_BITS)) & ((1 << SLICE_BITS) - 1)
            same = 1 if slice_ == slice_before else 0
            row_change = read_signed(state, data, models, _ROW + SIGNED * same)
            near = same * (1 + min(NEAR - 1, abs(row_change)))
            row = (row_before + row_change) & ((1 << ROW_BITS) - 1)
            column = column_before + read_signed(state, data, models, _COLUMN + SIGNED * near)
            column &= (1 << COLUMN_BITS) - 1
            column_before, row_before, slice_before = column, row, slice_
            start[n_runs] = (
                column
                | row << COLUMN_BITS
                | slice_ << (COLUMN_BITS + ROW_BITS)
                | (length - 1) << (COLUMN_BITS + ROW_BITS + SLICE_BITS)
            )
            a = read_tree(state, data, models, _A, 8)
            b = read_tree(state, data, models, _B + 256 * (a >> 5), 8)
            normal[n_runs, 0], normal[n_runs, 1] = a - 256 * (a >> 7), b - 256 * (b >> 7)
            n_runs += 1
            turns, step_before = 0, 0
            for _ in range(length - 1):
                turn = read_tree(state, data, models, _TURN + 8 * turns, 3)
                step_before = read_tree(state, data, models, _STEP + 32 * step_before, 5)
                step[at] = turn | step_before << 3
                turns = ((turns << 3) | turn) & 63
                at += 1
    return (n_sections, n_runs) if state[2] == len(data) else (0, 0)


def pack_runs(runs: GroupRuns) -> np.ndarray:
    """The runs of a group as bytes (n,) uint8.

    Guarantees: `unpack_runs` gives them back bit by bit; the same bytes on every machine; at most `most_bytes`.
    """
    counts = np.diff(runs.first.astype(np.int64), append=len(runs.start))
    assert runs.first[0] == 0 and counts.min() >= 1 and counts.max() <= MOST_RUNS
    assert np.abs(runs.base).max() <= MOST_INDEX and int((runs.start >> np.uint32(27)).sum()) == len(runs.step)
    out = np.empty(most_bytes(len(runs.start) + len(runs.step)), np.uint8)
    base, first, start, normal, step = (
        field.astype(np.int64) for field in (runs.base, runs.first, runs.start, runs.normal, runs.step)
    )
    return out[: _write(base, first, start, normal, step, out)].copy()


def unpack_runs(data: np.ndarray, n_cells: int) -> GroupRuns:
    """The way back of a group's bytes (n,) uint8.

    Raises: ValueError where bytes are not just those of runs of `n_cells` cells. Any bytes may come: none beyond them
    are read.
    """
    shapes = (n_cells, 3), (n_cells,), (n_cells,), (n_cells, 2), (n_cells,)
    base, first, start, normal, step = (np.empty(shape, np.int64) for shape in shapes)
    n_sections, n_runs = _read(np.ascontiguousarray(data), n_cells, base, first, start, normal, step)
    if not n_sections:
        raise ValueError(f"{len(data)} bytes of runs that are not those of {n_cells} cells")
    return GroupRuns(
        base[:n_sections].astype(np.int32),
        first[:n_sections].astype(np.uint32),
        start[:n_runs].astype(np.uint32),
        normal[:n_runs].astype(np.int8),
        step[: n_cells - n_runs].astype(np.uint8),
    )
