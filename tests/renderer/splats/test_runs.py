"""Runs decoded by the compute shader: bit by bit what the processor decodes."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.hcp import centres_of, key_of
from pipeline.geometry.runs.cells import search_size
from pipeline.geometry.runs.codes import decode_runs, encode_runs, positions_of
from pipeline.geometry.runs.walks import runs_of
from renderer.splats.runs import upload_runs
from tests.pipeline.geometry.runs.test_cells import sphere


def decoded_twice(context, keys: np.ndarray, normal: np.ndarray, size: float):
    codes, _ = encode_runs(keys, normal, runs_of(keys))
    index, code = decode_runs(codes)
    with context:
        gpu = upload_runs(context, codes, size)
        gpu.decode()
        found = gpu.read()
        gpu.release()
    return (positions_of(index, size), code), found


@pytest.mark.parametrize("n", [1, 300, 40_000])
def test_shader__decodes_the_bits_that_the_processor_does(n, renderer):
    cells = search_size(sphere(n), 2.5)
    normal = sphere(len(cells.key), seed=7)
    of_processor, of_shader = decoded_twice(renderer.context, cells.key, normal, cells.size)
    assert all(np.array_equal(a, b) for a, b in zip(of_processor, of_shader))
    where = centres_of(np.sort(cells.key), cells.size)
    order = np.lexsort(of_shader[0].T)
    different = np.unique(of_shader[0][order], axis=0)
    assert len(different) == len(where) and np.allclose(
        different, np.unique(where.astype(np.float32), axis=0), atol=1e-5
    )


def test_shader__of_lone_cells_far_from_zero(renderer):
    index = np.random.default_rng(0).integers(-(2**19), 2**19, (700, 3))
    keys = np.unique([key_of(*map(int, i)) for i in index])
    of_processor, of_shader = decoded_twice(renderer.context, keys, sphere(len(keys)), 0.37)
    assert all(np.array_equal(a, b) for a, b in zip(of_processor, of_shader))
