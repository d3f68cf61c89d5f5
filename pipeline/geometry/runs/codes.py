"""Runs of cells as a graphics card takes them, and back.

DuoDecim (2006), section 2.5: a start, then a byte a cell: 3 bits of step to one of 6 neighbours, 5 of step of the normal. Steps are
turns, (k - k before) mod 6, 0 straight on: bytes that repeat. What the paper keeps a slice is kept a group here: at most GROUP runs, in
a box of 2,048 columns, 2,048 rows and 32 slices, a workgroup's worth, which a box and a cone of normals cull.

A run's start is one word: 11 bits of column, 11 of row, 5 of slice against the group's base, 5 of length - 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.execution.compiled import kernel
from pipeline.geometry.hcp import ROW, SLICE, index_of, key_of, neighbour
from pipeline.geometry.normals import decode_normals, encode_normals
from pipeline.geometry.runs.normals import UNIT, decode_steps, encode_steps, learn_steps
from pipeline.geometry.runs.walks import RUN_LENGTH, Runs

GROUP = 256  # runs
COLUMN_BITS, ROW_BITS, SLICE_BITS, LENGTH_BITS = 11, 11, 5, 5
MOST_LENGTH = 1 << LENGTH_BITS
RUNS_A_SECTOR = 128  # on average: fewer would make tables of more than a tenth of a bit a cell
MOST_SECTORS = 8  # of the octahedral map, either way: runs of a group have normals of one of them


@dataclass(frozen=True)
class RunCodes:
    """What is packed. Cells stand run by run in all that is decoded."""

    base: np.ndarray  # (n_groups, 3) int32: column, row and slice that starts count from
    first_run: np.ndarray  # (n_groups,) uint32
    first_step: np.ndarray  # (n_groups,) uint32: of `step`
    start: np.ndarray  # (n_runs,) uint32
    normal: np.ndarray  # (n_runs, 2) int8, octahedral
    step: np.ndarray  # (n_cells - n_runs,) uint8: turn in the lowest 3 bits, above it the step of the normal
    codebook: np.ndarray  # (32, 2) int8

    @property
    def n_cells(self) -> int:
        return len(self.step) + len(self.start)

    def bits(self) -> dict[str, float]:
        """Bits a cell on a graphics card, by part."""
        n = self.n_cells
        tables = self.base.nbytes + self.first_run.nbytes + self.first_step.nbytes + self.codebook.nbytes
        return {
            "start": 32 * len(self.start) / n,
            "start_normal": 16 * len(self.start) / n,
            "steps": 3 * len(self.step) / n,
            "normals": 5 * len(self.step) / n,
            "tables": 8 * tables / n,
        }


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


def _grouped(first: np.ndarray, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The order of runs, box by box and in it by their mean normals (n_runs, 3), unit; and where each group begins in it."""
    box = np.stack([first[:, 2] >> SLICE_BITS, first[:, 1] >> ROW_BITS, first[:, 0] >> COLUMN_BITS])
    n_boxes = len(np.unique(box, axis=1).T)
    sectors = int(np.clip(math.sqrt(len(first) / (n_boxes * RUNS_A_SECTOR)), 1, MOST_SECTORS))
    square = (encode_normals(mean).astype(np.int64) + 127) * sectors // 255
    part = np.stack([*box, square[:, 0], square[:, 1]])
    order = np.lexsort([first[:, 0], first[:, 1], first[:, 2], *part[::-1]])
    changes = (np.diff(part[:, order], axis=1) != 0).any(axis=0)
    edges = np.concatenate([[0], np.flatnonzero(changes) + 1, [len(first)]])
    return order, np.concatenate([np.arange(a, b, GROUP) for a, b in zip(edges, edges[1:])])


def encode_runs(
    keys: np.ndarray, normal: np.ndarray, runs: Runs, codebook: np.ndarray | None = None
) -> tuple[RunCodes, np.ndarray]:
    """Codes of runs of cells (n,) with normals (n, 3), unit; and the place among the given cells of each that is decoded, (m,).

    Guarantees: what `decode_runs` gives are these cells; a normal's error does not add up along a run.
    """
    assert len(keys) and RUN_LENGTH <= MOST_LENGTH
    starts = np.stack(index_of(keys[runs.cells[runs.start[:-1]]]), axis=1)
    order, first_run = _grouped(starts, _mean_normals(normal[runs.cells], runs.start))
    length = np.diff(runs.start)[order]
    begin = np.concatenate([[0], np.cumsum(length)])
    source = np.repeat(runs.start[:-1][order] - begin[:-1], length) + np.arange(begin[-1])
    cells = runs.cells[source]
    turn = np.empty(len(cells), np.uint8)
    joined = _turns(keys, cells, begin, turn)
    assert joined == 0, "cells side by side in a run are neighbours"
    target, goal = normal[cells], encode_normals(normal[cells])
    book = learn_steps(target, goal, begin) if codebook is None else codebook
    step, place = np.empty(len(cells), np.uint8), np.empty((len(cells), 2), np.int8)
    encode_steps(target, goal[begin[:-1]], begin, book, UNIT, step, place)
    inner = np.ones(len(cells), bool)
    inner[begin[:-1]] = False
    base = starts[order][first_run] & [-1 << COLUMN_BITS, -1 << ROW_BITS, -1 << SLICE_BITS]
    group = np.searchsorted(first_run, np.arange(len(order)), side="right") - 1
    column, row, slice_ = (starts[order] - base[group]).T
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


def _mean_normals(normal: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Of each run (n_runs, 3), unit; that of its start where they cancel."""
    total = np.add.reduceat(normal, start[:-1], axis=0)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 1e-9, total / np.maximum(length, 1e-9), normal[start[:-1]])


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


def cones(codes: RunCodes) -> tuple[np.ndarray, np.ndarray]:
    """Axis (n_groups, 3) and half angle in radians (n_groups,) of a cone that holds all decoded normals of each group."""
    _, place = decode_runs(codes)
    normal = decode_normals(place)
    begin = codes.first_run.astype(np.int64) + codes.first_step
    total = np.add.reduceat(normal, begin, axis=0)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    axis = np.where(length > 1e-9, total / np.maximum(length, 1e-9), [0.0, 0.0, 1.0])
    group = np.repeat(np.arange(len(begin)), np.diff(np.concatenate([begin, [len(normal)]])))
    cosine = np.minimum.reduceat(np.clip((normal * axis[group]).sum(axis=1), -1, 1), begin)
    return axis, np.arccos(cosine)
