"""What do the guards of hard cases cost on ordinary scans?

    python -m benchmarks.guards SCAN [--packed FILE] [--atoms 256] [--patches 8192] [--rounds 9] [--json]

Each piece of work runs in turns with a copy of itself that has its guards taken out (docs/NUMERICS.md says what they
are for); what is printed are medians of processor seconds, of all threads, and the median of the ratios of pairs. The
copies code ordinary patches to the very same atoms. With --packed, frames of that file too.
"""

from __future__ import annotations

import json
import sys
import time
import types
from pathlib import Path

import numpy as np

from benchmarks.patches import arguments, learned_dictionary, textured_patches
from pipeline.coding import ksvd, omp, omp_kernels
from pipeline.execution.threads import one_blas_thread
from pipeline.texture import patches as texture_patches
from pipeline.texture.patches import Block, make_patches
from renderer.splats.renderer import Renderer
from renderer.splats.scene import GpuScene
from renderer.splats.targets import NARROW
from storage.packed.packed import PackedFile
from storage.packed.schema import Camera

N_ATOMS = 8
REPEATS = 50  # of a pursuit, which takes a microsecond a patch
TOLERANCE = 3072 * 10**-4.0  # 40 dB
PHOTO = np.random.default_rng(0).integers(0, 256, (1024, 1536, 3)).astype(np.uint8)


def without(module: types.ModuleType, *guards: tuple[str, str]) -> types.ModuleType:
    """A copy of a module in which the text of each guard is replaced; a guard that is not there is an error."""
    source = (
        open(module.__file__)
        .read()
        .replace("@kernel(", "@kernel(cache=False, ")
        .replace("@part(", "@part(cache=False, ")
    )
    for guard, instead in guards:
        if guard not in source:
            raise SystemExit(f"{module.__name__} has no guard {guard!r} any more")
        source = source.replace(guard, instead)
    copy = types.ModuleType(f"{module.__name__}_without_guards")
    sys.modules[copy.__name__] = copy
    exec(compile(source, f"{module.__name__} without guards", "exec"), vars(copy))
    return copy


def pursuits(patches: np.ndarray, dictionary: np.ndarray) -> dict:
    """OMP with and without the test of the pivot, of what is signal, and of an error that must not rise."""
    plain = without(
        omp_kernels,
        ("SMALLEST_PIVOT = 2e-3", "SMALLEST_PIVOT = 0.0"),
        ("SMALLEST_CORRELATION = 1e-6", "SMALLEST_CORRELATION = 0.0"),
        ("            if lowered >= error - multiplier:\n                break\n", ""),
    )
    y, d = patches.astype(np.float32), dictionary.astype(np.float32)
    initial, gram, energy = y @ d.T, d @ d.T, omp_kernels.squared_norms(y)
    found = {}

    def run(kernels: types.ModuleType) -> None:
        n = len(y)
        atom, weight, code = np.zeros((n, N_ATOMS), np.int32), np.zeros((n, N_ATOMS)), np.zeros((n, N_ATOMS), np.int32)
        for _ in range(REPEATS):
            kernels.pursue(
                y,
                d,
                initial,
                np.zeros(n, np.float32),
                np.zeros(len(d), np.float32),
                True,
                energy,
                gram,
                omp_kernels.ONLY_IDENTITY,
                np.full(n, TOLERANCE),
                0.0,
                np.empty((N_ATOMS, 0)),
                atom,
                weight,
                code,
                np.zeros(n, np.int32),
                np.zeros((n, N_ATOMS + 1)),
            )
        found[kernels.__name__] = atom

    works = {"guarded": lambda: run(omp_kernels), "plain": lambda: run(plain)}
    for work in works.values():
        work()
    first, second = found.values()
    assert (first == second).all(), "ordinary patches are coded differently without guards"
    return works


def projections() -> dict:
    """Patches of a wall in front of one camera, with and without the tests of what the camera sees whole."""
    n = 4096
    rng = np.random.default_rng(1)
    camera = Camera(
        "photo", 1536, 1024, 1200.0, 1200.0, 768.0, 512.0, ((1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0)), (0.0, 0.0, 0.0)
    )
    centre = np.column_stack([rng.uniform(-1, 1, (n, 2)) * [2.3, 1.5], np.full(n, 4.0)])
    frame = np.tile([1.0, 0, 0], (n, 1)), np.tile([0.0, 1, 0], (n, 1))
    own = texture_patches.is_whole, texture_patches.is_in_front

    def run(is_whole, is_in_front) -> None:
        texture_patches.is_whole, texture_patches.is_in_front = is_whole, is_in_front
        try:
            block = Block(
                (camera,),
                lambda i, left, top, right, bottom: PHOTO[top:bottom, left:right],
                (0.0, 0.0, 0.0),
                centre,
                frame,
                0.012,
                np.zeros(n, np.uint16),
                np.zeros((n, 3), np.uint8),
            )
            make_patches(block, 0)
        finally:
            texture_patches.is_whole, texture_patches.is_in_front = own

    everything = lambda h, *size: np.ones(len(h), bool)
    return {"guarded": lambda: run(*own), "plain": lambda: run(everything, everything)}


def learning(patches: np.ndarray, n_atoms: int) -> dict:
    """Four iterations of k-SVD with and without judging each dictionary and keeping the best."""
    plain = without(
        ksvd,
        ("return sums.error <= (1 + TOLERATED_RISE) * best.sums.error", "return True"),
        ("    if best is None or sums.error <= best.sums.error:\n        return", "    if True:\n        return"),
    )
    own = {"max_atoms": N_ATOMS, "tolerance": TOLERANCE, "iterations": 4}
    works = {
        "guarded": lambda: ksvd.learn_dictionary(patches, n_atoms, **own),
        "plain": lambda: plain.learn_dictionary(patches, n_atoms, **own),
    }
    first, second = (work() for work in works.values())
    assert (first == second).all(), "ordinary patches are learned differently without guards"
    return works


def checks(patches: np.ndarray, dictionary: np.ndarray) -> dict:
    """Coding with and without looking at every input for what is not finite."""
    own = omp._checked

    def run(checked) -> None:
        omp._checked = checked
        try:
            omp.sparse_encode(patches, dictionary, max_atoms=N_ATOMS, tolerance=TOLERANCE, n_threads=1)
        finally:
            omp._checked = own

    return {"guarded": lambda: run(own), "plain": lambda: run(lambda dictionary: dictionary)}


def frames(packed: Path) -> dict:
    """Three frames, and loading the scene, with and without looking for overdraw and for stacks of copies."""
    with PackedFile(packed) as file:
        scene = file.load()
    renderer = Renderer()
    views = scene.header.cameras[:: max(1, len(scene.header.cameras) // 3)][:3]

    def run(watched: bool) -> None:
        scene.header.settings["effects"] = "" if watched else "accumulation=off"
        gpu_scene = GpuScene(scene, renderer.context)
        assert {renderer.render(gpu_scene, view).accumulation for view in views} == {NARROW}, "this is no ordinary scan"
        gpu_scene.release()

    return {"guarded": lambda: run(True), "plain": lambda: run(False)}


def pairs_of(works: dict, rounds: int) -> dict:
    """Median processor seconds of both, and the median and the quartiles of the ratios of pairs, the order taking
    turns."""
    taken = {name: [] for name in works}
    for round_ in range(rounds + 1):
        for name in list(works)[:: 1 if round_ % 2 else -1]:
            begun = time.process_time()
            works[name]()
            taken[name].append(time.process_time() - begun)
    guarded, plain = (np.array(taken[name][1:]) for name in ("guarded", "plain"))
    low, ratio, high = np.quantile(guarded / plain, (0.25, 0.5, 0.75))
    return {
        "guarded_s": float(np.median(guarded)),
        "plain_s": float(np.median(plain)),
        "ratio": float(ratio),
        "quartiles": [float(low), float(high)],
    }


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--packed", type=Path)
    options = parser.parse_args()
    patches = textured_patches(options.scan, options.patches)
    n_atoms = options.atoms[0]
    dictionary = learned_dictionary(patches, n_atoms)[0]
    pairs = {
        "pursuit": pursuits(patches, dictionary),
        "projection": projections(),
        "learning": learning(patches, n_atoms),
        "checks of inputs": checks(patches, dictionary),
    }
    if options.packed:
        pairs["frames"] = frames(options.packed)
    with one_blas_thread():
        found = {name: pairs_of(works, options.rounds) for name, works in pairs.items()}
    if options.json:
        print(json.dumps({"atoms": n_atoms, "patches": len(patches), "guards": found}))
        return
    for name, row in found.items():
        print(
            f"{name:18} guarded {row['guarded_s']:.4f} s, plain {row['plain_s']:.4f} s, ratio {row['ratio']:.3f} "
            f"({row['quartiles'][0]:.3f} to {row['quartiles'][1]:.3f})"
        )


if __name__ == "__main__":
    main()
