"""Scenes whose geometry is runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.geometry.hcp import centres_of, key_of
from pipeline.geometry.runs.codes import encode_runs, turn_across
from pipeline.geometry.runs.walks import runs_of
from storage.packed.scene import PackedScene
from storage.packed.schema import FORMS, GROUP, RUNS, RunGrid

CELL = 0.06


def on_runs(scene: PackedScene, axis: int = 0) -> PackedScene:
    """The splats of a scene of boxes, moved one by one to the cells of a wavy sheet and turned along it; everything
    else stays."""
    n = scene.header.n_splats
    side = int(np.ceil(np.sqrt(n)))
    column, row = np.divmod(np.arange(n), side)
    slice_ = np.rint(2 * np.sin(column / 5)).astype(int)
    keys = np.sort([key_of(int(c) - side // 2, int(r) - side // 2, int(s)) for c, r, s in zip(column, row, slice_)])
    place = centres_of(keys, 1.0)
    normal = np.stack([0.3 * np.cos(place[:, 0] / 5), 0.2 * np.sin(place[:, 1]), np.ones(n)], axis=1)
    runs = runs_of(keys, bridge=0)
    assert len(runs.cells) == n
    codes, _ = encode_runs(keys, normal / np.linalg.norm(normal, axis=1, keepdims=True), runs)
    begin = codes.first_run.astype(int) + codes.first_step
    arrays = {name: values for name, values in scene.arrays.items() if name not in FORMS}
    arrays |= {"run_base": codes.base, "run_first": codes.first_run, "run_start": codes.start, "run_normal": codes.normal,
               "run_step": codes.step, "run_codebook": codes.codebook,
               "run_section": np.flatnonzero(begin % GROUP == 0).astype(np.uint32)}  # fmt: skip
    if len(scene.header.batches) > 1:
        shuffled = scene.rows.batch.copy()
        for at in range(0, n, 128):
            np.random.default_rng(at).shuffle(shuffled[at : at + 128])
        arrays["run_batch"] = shuffled
    grid = RunGrid(CELL, turn_across(axis), len(codes.base), len(codes.start))
    return PackedScene(replace(scene.header, geometry=RUNS, runs=grid, levels=()), arrays)
