"""Results do not depend on what a process has compiled, and what it has loaded from the cache of compiled kernels."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]

WORK = """
import hashlib, sys
import numpy as np
from pipeline.coding import omp_kernels
from pipeline.coding.search.stepwise import shorten
from pipeline.coding.search.coarse import coarsen
from pipeline.coding.ksvd import learn_dictionary
from pipeline.coding.omp import pursue_patches
from pipeline.coding.search.symmetric import with_symmetries
from pipeline.texture.resample import Window, resample_patches, resampling_error

rng = np.random.default_rng(0)
if sys.argv[1] == "parts first":
    row = np.ones(5, np.float32)
    omp_kernels.dot(row, row)
    omp_kernels.subtract_rows(row, np.ones((2, 5), np.float32), np.zeros(2, np.int32), np.ones(2), 2)
patches = np.cumsum(rng.standard_normal((1200, 192)), axis=1).astype(np.float32)
atoms = learn_dictionary(patches, 150, max_atoms=5, tolerance=1.0, iterations=3)
found = [atoms]
levels = np.tile(np.linspace(-40, 40, 16), (5, 1))
for searched in (coarsen(atoms, components=24), shorten(atoms, components=24), with_symmetries(atoms, 8)):
    for weight_levels in (None, levels):
        pursuit = pursue_patches(patches, searched, max_atoms=5, weight_levels=weight_levels, search="certified")
        found += [*pursuit.codes, pursuit.path]
window = Window(rng.integers(0, 256, (64, 64, 3), np.uint8), 0, 0)
homography = np.tile([[6.0, 1.3, 31.0], [-1.1, 7.0, 30.0], [0.001, 0.002, 1.0]], (50, 1, 1)) + 1e-3 * rng.standard_normal((50, 3, 3))
texel = resample_patches(window, homography)
found += [texel, resampling_error(texel, np.arange(50), window, homography, 0)]
print(hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in found)).hexdigest())
"""


def start(cache: Path, parts: str = "") -> subprocess.Popen:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": str(ROOT), "NUMBA_DEBUG_CACHE": "1"}
    return subprocess.Popen([sys.executable, "-c", WORK, parts], env=environment, stdout=subprocess.PIPE, text=True)


def outcome(process: subprocess.Popen) -> tuple[str, list[str]]:
    """The hash that it prints, and the kernels that it compiled."""
    *told, digest = process.communicate()[0].splitlines()
    assert process.returncode == 0
    return digest, [line for line in told if "data saved" in line]


def test_compiled__processes_compile_each_kernel_once_and_agree_to_the_last_bit(tmp_path):
    cache = tmp_path / "cache"
    (first, by_first), (second, by_second) = map(outcome, [start(cache), start(cache)])
    assert first == second
    assert len(by_first) + len(by_second) == len(list(cache.rglob("*.nbc"))) > 20
    warm, by_warm = outcome(start(cache, "parts first"))
    assert warm == first and len(by_warm) <= 2  # the parts, as they are called here
