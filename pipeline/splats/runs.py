"""The runs of a packed file -> positions and normals of its splats, in the file's order."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.runs.codes import RunCodes, decode_runs, positions_of, turned
from storage.packed.runs.tables import cell_order, lengths_of
from storage.packed.scene import PackedScene


def codes_of(scene: PackedScene) -> RunCodes:
    """The arrays of a packed file whose geometry is runs, or of a group of it."""
    a = scene.arrays
    before = np.concatenate([[0], np.cumsum(lengths_of(a["run_start"]))])
    first = a["run_first"].astype(np.int64)
    return RunCodes(
        a["run_base"],
        a["run_first"],
        (before[first] - first).astype(np.uint32),
        a["run_start"],
        a["run_normal"],
        a["run_step"],
        a["run_codebook"],
    )


def places_of(scene: PackedScene) -> np.ndarray:
    """The splat (n,) int64 that each cell is, in the order of the runs."""
    order = cell_order(scene.arrays.get("run_batch"), scene.header.n_splats)
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    return place


def decoded_splats(scene: PackedScene) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, 3) float32 against the origin and octahedral normals (n, 2) int8 of all splats.

    Guarantees: the same bits as the compute shader's and the viewer's.
    """
    grid = scene.header.runs
    assert grid is not None
    index, normal = decode_runs(codes_of(scene))
    order = cell_order(scene.arrays.get("run_batch"), scene.header.n_splats)
    return turned(positions_of(index, grid.cell), grid.turn)[order], normal[order]
