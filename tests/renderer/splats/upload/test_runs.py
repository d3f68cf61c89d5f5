"""Runs decoded by the compute shader: bit by bit what the processor decodes."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.hcp import centres_of, key_of
from pipeline.geometry.runs.cells import in_grid, search_size
from pipeline.geometry.runs.codes import encode_runs, turn_across
from pipeline.geometry.runs.walks import runs_of
from pipeline.splats.runs import decoded_splats
from renderer.splats.upload.runs import upload_runs
from storage.packed.scene import PackedScene
from storage.packed.schema import GROUP, RUNS, Batch, Header, RunGrid
from tests.packed_files import Case, arrays_for, header_of
from tests.pipeline.geometry.runs.test_cells import sphere


def scene_of(keys: np.ndarray, normal: np.ndarray, size: float, axis: int) -> PackedScene:
    codes, place = encode_runs(keys, normal, runs_of(keys))
    begin = codes.first_run.astype(int) + codes.first_step
    arrays = {"run_base": codes.base, "run_first": codes.first_run, "run_start": codes.start, "run_normal": codes.normal,
              "run_step": codes.step, "run_codebook": codes.codebook,
              "run_section": np.flatnonzero(begin % GROUP == 0).astype(np.uint32)}  # fmt: skip
    grid = RunGrid(size, turn_across(axis), len(codes.base), len(codes.start))
    header = Header(len(place), 1.0, "m", (0.0, 0.0, 0.0), (0, 0, 1), (1, 0, 0), 1.0, 0, 1, 4, (Batch(0),), (), {}, {},
                    geometry=RUNS, runs=grid)  # fmt: skip
    return PackedScene(header, arrays)


def decoded_twice(context, scene: PackedScene):
    with context:
        gpu = upload_runs(context, scene)
        gpu.decode()
        found = gpu.read()
        gpu.release()
    return decoded_splats(scene), found


@pytest.mark.parametrize("n, axis", [(1, 0), (300, 1), (40_000, 0), (40_000, 2)])
def test_shader__decodes_the_bits_that_the_processor_does(n, axis, renderer):
    cells = search_size(sphere(n), 2.5)
    scene = scene_of(cells.key, sphere(len(cells.key), seed=7), cells.size, axis)
    of_processor, of_shader = decoded_twice(renderer.context, scene)
    assert all(np.array_equal(a, b) for a, b in zip(of_processor, of_shader))
    where = centres_of(cells.key, cells.size)
    different = np.unique(in_grid(of_shader[0], axis), axis=0)
    assert len(different) == len(where)
    assert np.allclose(different, np.unique(where.astype(np.float32), axis=0), atol=1e-5)


def test_shader__of_lone_cells_far_from_zero(renderer):
    index = np.random.default_rng(0).integers(-(2**19), 2**19, (700, 3))
    keys = np.unique([key_of(*map(int, i)) for i in index])
    of_processor, of_shader = decoded_twice(renderer.context, scene_of(keys, sphere(len(keys)), 0.37, 1))
    assert all(np.array_equal(a, b) for a, b in zip(of_processor, of_shader))


def test_shader__puts_cells_of_several_batches_in_their_places(renderer):
    case = Case(n_splats=GROUP + 300, atom_counts=(0, 1, 3), runs=True)
    scene = PackedScene(header_of(case), arrays_for(case, header_of(case)))
    of_processor, of_shader = decoded_twice(renderer.context, scene)
    assert all(np.array_equal(a, b) for a, b in zip(of_processor, of_shader))
