"""Runs of cells as a graphics card takes them, and back.

DuoDecim (2006), section 2.5: a start, then a byte a cell: 3 bits of step to one of 6 neighbours, 5 of step of the normal. Steps are
turns, (k - k before) mod 6, 0 straight on: bytes that repeat. What the paper keeps a slice is kept a section here: at most
MOST_RUNS runs, in a box of 2,048 columns, 2,048 rows and 32 slices, a workgroup's worth, which a box and a cone of normals cull.

A run's start is one word: 11 bits of column, 11 of row, 5 of slice against the section's base, 5 of length - 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.execution.compiled import kernel
from pipeline.geometry.hcp import INDEX_BITS, ROW, SLICE, index_of, key_of, neighbour
from pipeline.geometry.normals import decode_normals, encode_normals
from pipeline.geometry.runs.normals import decode_steps, encode_steps, learn_steps
from pipeline.geometry.runs.walks import RUN_LENGTH, Runs
from storage.packed.schema import COLUMN_BITS, GROUP, LENGTH_BITS, MOST_RUNS, ROW_BITS, SLICE_BITS

MOST_LENGTH = 1 << LENGTH_BITS
BLOCK_BITS = (
    4  # of cells either way that runs start in before those of the next block: of 0 to 5 the fewest bits on disk
)


@dataclass(frozen=True)
class RunCodes:
    """What is packed. Cells stand run by run in all that is decoded."""

    base: np.ndarray  # (n_sections, 3) int32: column, row and slice that starts count from
    first_run: np.ndarray  # (n_sections,) uint32
    first_step: np.ndarray  # (n_sections,) uint32: of `step`
    start: np.ndarray  # (n_runs,) uint32
    normal: np.ndarray  # (n_runs, 2) int8, octahedral
    step: np.ndarray  # (n_cells - n_runs,) uint8: turn in the lowest 3 bits, above it the step of the normal
    codebook: np.ndarray  # (32, 2) int8

    @property
    def n_cells(self) -> int:
        return len(self.step) + len(self.start)


@kernel()
def _turns(keys, cells, start, turn):
    """Turn (m,) uint8 to each cell of each run from the one before, 0 at starts; -1 is returned where two are no neighbours, else 0."""
    for r in range(len(start) - 1):
        before = 0
        for at in range(start[r], start[r + 1]):
            if at == start[r]:
                turn[at] = 0
                continue
            column, row, slice_ = index_of(keys[cells[at - 1]])
            found = -1
            for k in range(6):
                there = neighbour(column, row, slice_, k)
                if key_of(there[0], there[1], there[2]) == keys[cells[at]]:
                    found = k
            if found < 0:
                return -1
            turn[at] = (found - before) % 6
            before = found
    return 0


@kernel()
def _walk(first, start, turn, index):
    """Column, row and slice (m, 3) of all cells from those of starts (n_runs, 3)."""
    for r in range(len(start) - 1):
        column, row, slice_ = first[r]
        k = 0
        for at in range(start[r], start[r + 1]):
            if at > start[r]:
                k = (k + turn[at]) % 6
                column, row, slice_ = neighbour(column, row, slice_, k)
            index[at, 0], index[at, 1], index[at, 2] = column, row, slice_


@dataclass(frozen=True)
class _Ordered:
    """Runs in the order of the file: run r is cells[begin[r] : begin[r + 1]]."""

    cells: np.ndarray  # (m,)
    begin: np.ndarray  # (n_runs + 1,)
    first: np.ndarray  # (n_runs, 3) column, row and slice of starts
    first_run: np.ndarray  # (n_sections,)


def _ordered(keys: np.ndarray, runs: Runs, first_cell: int) -> _Ordered:
    """Runs box by box and in it block by block along a Morton curve, cut where a group of splats ends; `first_cell` cells stand before them."""
    starts = keys[runs.cells[runs.start[:-1]]]
    index = _index(starts)
    order = np.lexsort([starts, _morton(index >> BLOCK_BITS), *_boxes(index)[::-1]])
    length = np.diff(runs.start)[order]
    whole = np.concatenate([[0], np.cumsum(length)])
    cells = runs.cells[np.repeat(runs.start[:-1][order] - whole[:-1], length) + np.arange(whole[-1])]
    ends = np.arange(GROUP - first_cell % GROUP, whole[-1], GROUP)
    begin = np.union1d(whole, ends)
    first = _index(keys[cells[begin[:-1]]])
    part = np.stack([*_boxes(first), (begin[:-1] + first_cell) // GROUP])
    changes = (np.diff(part, axis=1) != 0).any(axis=0)
    edges = np.concatenate([[0], np.flatnonzero(changes) + 1, [len(first)]])
    return _Ordered(cells, begin, first, np.concatenate([np.arange(a, b, MOST_RUNS) for a, b in zip(edges, edges[1:])]))


def _morton(block: np.ndarray) -> np.ndarray:
    """Where blocks (n, 3) int64, of at most 21 bits, stand on a curve of Morton's (1966): their bits, interleaved; (n,) int64."""
    at = np.zeros(len(block), np.int64)
    for bit in range(INDEX_BITS - BLOCK_BITS):
        at |= ((block >> bit & 1) << np.arange(3) + 3 * bit).sum(axis=1)
    return at


def _index(keys: np.ndarray) -> np.ndarray:
    return np.stack(index_of(keys), axis=1)


def _boxes(first: np.ndarray) -> np.ndarray:
    """The box of each start, (3, n): slices, rows, columns."""
    return np.stack([first[:, 2] >> SLICE_BITS, first[:, 1] >> ROW_BITS, first[:, 0] >> COLUMN_BITS])


def encode_runs(
    keys: np.ndarray, normal: np.ndarray, runs: Runs, codebook: np.ndarray | None = None, first_cell: int = 0
) -> tuple[RunCodes, np.ndarray]:
    """Codes of runs of cells (n,) with normals (n, 3), unit; and the place among the given cells of each that is decoded, (m,).
    `first_cell` cells stand before them in the file.

    Guarantees: what `decode_runs` gives are these cells; a normal's error does not add up along a run; no section reaches over
    the end of a group of splats.
    """
    assert len(keys) and RUN_LENGTH <= MOST_LENGTH
    ordered = _ordered(keys, runs, first_cell)
    cells, begin, first_run = ordered.cells, ordered.begin, ordered.first_run
    turn = np.empty(len(cells), np.uint8)
    joined = _turns(keys, cells, begin, turn)
    assert joined == 0, "cells side by side in a run are neighbours"
    target, goal = normal[cells], encode_normals(normal[cells])
    book = learn_steps(target, goal, begin) if codebook is None else codebook
    step, place = np.empty(len(cells), np.uint8), np.empty((len(cells), 2), np.int8)
    encode_steps(target, goal, goal[begin[:-1]], begin, book, step, place)
    inner = np.ones(len(cells), bool)
    inner[begin[:-1]] = False
    base = ordered.first[first_run] & [-1 << COLUMN_BITS, -1 << ROW_BITS, -1 << SLICE_BITS]
    section = np.searchsorted(first_run, np.arange(len(begin) - 1), side="right") - 1
    column, row, slice_ = (ordered.first - base[section]).T
    length = np.diff(begin)
    word = (
        column
        | row << COLUMN_BITS
        | slice_ << COLUMN_BITS + ROW_BITS
        | length - 1 << COLUMN_BITS + ROW_BITS + SLICE_BITS
    )
    codes = RunCodes(
        base.astype(np.int32),
        first_run.astype(np.uint32),
        (begin[first_run] - first_run).astype(np.uint32),
        word.astype(np.uint32),
        goal[begin[:-1]],
        (turn | step << 3)[inner],
        book,
    )
    return codes, cells


def decode_runs(codes: RunCodes) -> tuple[np.ndarray, np.ndarray]:
    """Column, row and slice (m, 3) int64 of all cells, and their normals as octahedral codes (m, 2) int8.

    Guarantees: in whole numbers throughout, as the shader does it: the same bits.
    """
    word = codes.start.astype(np.int64)
    fields, shift = [], 0
    for bits in (COLUMN_BITS, ROW_BITS, SLICE_BITS, LENGTH_BITS):
        fields.append(word >> shift & (1 << bits) - 1)
        shift += bits
    group = np.searchsorted(codes.first_run, np.arange(len(word)), side="right") - 1
    first = np.stack(fields[:3], axis=1) + codes.base[group]
    begin = np.concatenate([[0], np.cumsum(fields[3] + 1)])
    inner = np.ones(begin[-1], bool)
    inner[begin[:-1]] = False
    byte = np.zeros(begin[-1], np.uint8)
    byte[inner] = codes.step
    index, place = np.empty((len(byte), 3), np.int64), np.empty((len(byte), 2), np.int8)
    _walk(first, begin, byte & 7, index)
    decode_steps(codes.normal, begin, codes.codebook, byte >> 3, place)
    return index, place


def pitch_of(size: float) -> np.ndarray:
    """Half a column, a third of a row and a slice (3,) float32: what coordinates of cells are whole multiples of."""
    return np.array([size / 2, size * ROW / 3, size * SLICE], np.float32)


def positions_of(index: np.ndarray, size: float) -> np.ndarray:
    """The centres (m, 3) float32 of cells by column, row and slice, against cell (0, 0, 0), in the grid's frame.

    Guarantees: one product a coordinate, of a whole number that float32 holds: the same bits as the shader's.
    """
    column, row, slice_ = index.T
    units = np.stack([2 * column + ((row ^ slice_) & 1), 3 * row + (slice_ & 1), slice_], axis=1)
    return units.astype(np.float32) * pitch_of(size)


def turned(position: np.ndarray, turn: tuple[float, ...]) -> np.ndarray:
    """Positions (m, 3) float32 of the grid's axes in those of the file, by the rows of a matrix.

    Guarantees: three products and two sums a coordinate, each rounded to float32, as the shader and the viewer do it.
    """
    rows = np.array(turn, np.float32).reshape(3, 3)
    x, y, z = position.T
    return np.stack([(row[0] * x + row[1] * y) + row[2] * z for row in rows], axis=1)


def turn_across(axis: int) -> tuple[float, ...]:
    """The matrix of a grid whose slices lie across an axis of the file; handedness stays.

    >>> turn_across(2)
    (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    """
    return tuple(np.roll(np.eye(3), axis - 2, axis=0).ravel().tolist())


def cones(codes: RunCodes) -> tuple[np.ndarray, np.ndarray]:
    """Axis (n_sections, 3) and half angle in radians (n_sections,) of a cone that holds all decoded normals of each section."""
    _, place = decode_runs(codes)
    normal = decode_normals(place)
    begin = codes.first_run.astype(np.int64) + codes.first_step
    total = np.add.reduceat(normal, begin, axis=0)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    axis = np.where(length > 1e-9, total / np.maximum(length, 1e-9), [0.0, 0.0, 1.0])
    group = np.repeat(np.arange(len(begin)), np.diff(np.concatenate([begin, [len(normal)]])))
    cosine = np.minimum.reduceat(np.clip((normal * axis[group]).sum(axis=1), -1, 1), begin)
    return axis, np.arccos(cosine)
