"""How fast this machine is at the work of the stages, beside the one that `costs.json` was measured on."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from pipeline.coding.grid import SYMMETRIES, coefficients
from pipeline.coding.omp import pursue_patches
from pipeline.coding.search.symmetric import with_symmetries
from pipeline.execution.threads import one_blas_thread
from pipeline.geometry.chunks import median_split
from pipeline.texture.patches import centred
from pipeline.texture.resample import PATCH_DIM

N_PATCHES, N_ATOMS, N_POINTS = 1024, 1024, 32_768
ROUNDS = 15


def probe_seconds() -> float:
    """Processor seconds of one thread for a fixed piece of work like that of the stages: patches to floats and to
    coefficients, a pursuit, points split. The least of some rounds of 15 ms, which a neighbour of a moment does not
    fill; kernels are compiled before."""
    rng = np.random.default_rng(0)
    texel = rng.integers(0, 256, (N_PATCHES, PATCH_DIM), np.uint8)
    average = rng.integers(0, 256, (N_PATCHES, 3), np.uint8)
    atoms = rng.standard_normal((N_ATOMS // SYMMETRIES, 3 * 64)).astype(np.float32)
    turned = with_symmetries(atoms / np.linalg.norm(atoms, axis=1, keepdims=True), 8)
    points = rng.standard_normal((N_POINTS, 3))

    def work() -> None:
        patches = coefficients(centred(texel, average), 8)
        pursue_patches(patches, turned, max_atoms=8)
        median_split(points)

    with one_blas_thread():
        work()
        return min(_processor_seconds(work) for _ in range(ROUNDS))


def _processor_seconds(work: Callable[[], None]) -> float:
    begun = time.thread_time()
    work()
    return time.thread_time() - begun
