"""Where does each kernel of coding and learning stand between what memory and what arithmetic allow?

    python -m benchmarks.roofline SCAN [--atoms 256 4096] [--patches 8192] [--json]

One thread, processor time, the least of the rounds. First the machine: float32 GEMM `Y D^T`, and a sum of two long rows
out of memory (three streams). Then each kernel: microseconds a patch, arithmetic and bytes it cannot do without (what
its definition says, not what counters say), and the shares of the two rates that makes. 8 atoms, no cut-off.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable

import numpy as np
import threadpoolctl

from benchmarks.patches import arguments, learned_dictionary, textured_patches
from pipeline.coding.ksvd import block_sums
from pipeline.coding.omp_kernels import squared_norms
from pipeline.coding.search.choice import ready_for
from pipeline.coding.subspace import project
from pipeline.stages.texture.atoms import Atoms
from pipeline.texture.patches import centred

N_ATOMS = 8


def least(work: Callable[[], object], rounds: int) -> float:
    taken = []
    for _ in range(rounds + 1):
        begun = time.process_time()
        work()
        taken.append(time.process_time() - begun)
    return min(taken[1:])


def rates(patches: np.ndarray, dictionary: np.ndarray, rounds: int) -> tuple[float, float]:
    """Operations a second of the GEMM, bytes a second of a sum of rows of 256 MiB."""
    a, b, c = (np.ones(1 << 26, np.float32) for _ in range(3))
    gemm = 2.0 * len(patches) * dictionary.size / least(lambda: patches @ dictionary.T, rounds)
    return gemm, 3.0 * a.nbytes / least(lambda: np.add(a, b, out=c), rounds)


def kernels(patches: np.ndarray, dictionary: np.ndarray, basis: np.ndarray) -> dict[str, tuple[Callable, float, float]]:
    """Name -> what to run, operations a patch, bytes a patch."""
    (k, d), p, t = dictionary.shape, basis.shape[1], N_ATOMS
    coefficients, short = patches @ basis, dictionary @ basis
    short /= np.linalg.norm(short, axis=1, keepdims=True)
    whole, inside = (Atoms(ready_for("certified", rows)) for rows in (dictionary, short))
    found = {"whole": whole.pursue(patches, t, 0.0), "in components": inside.pursue(coefficients, t, 0.0)}
    texel = np.clip(patches * 255 + 128, 0, 255).astype(np.uint8)
    average = np.full((len(patches), 3), 128, np.uint8)
    steps = 2.0 * k * t * (t - 1) / 2  # rows of the Gram matrix that follow the residual
    return {
        "centring": (lambda: centred(texel, average), 2.0 * d, 5.0 * d),
        "squared norms": (lambda: squared_norms(patches), 2.0 * d, 4.0 * d),
        "GEMM of whole patches": (lambda: patches @ dictionary.T, 2.0 * k * d, 4.0 * (d + k)),
        "projection on components": (lambda: project(patches, basis), 2.0 * p * d, 4.0 * (d + p)),
        "pursuit, whole patches": (
            lambda: whole.pursue(patches, t, 0.0),
            2.0 * k * _width_of_products(whole, d) + steps,
            4.0 * k * t * (t - 1) / 2,
        ),
        "pursuit, in components": (
            lambda: inside.pursue(coefficients, t, 0.0),
            2.0 * k * p + steps,
            4.0 * k * t * (t - 1) / 2,
        ),
        "sums, whole patches": (
            lambda: block_sums(patches, dictionary, found["whole"]),
            4.0 * t * d,
            4.0 * d * (1 + 3 * t),
        ),
        "sums, in components": (
            lambda: block_sums(coefficients, short, found["in components"]),
            4.0 * t * p,
            4.0 * p * (1 + 3 * t),
        ),
    }


def _width_of_products(atoms: Atoms, whole: int) -> int:
    return atoms.searched.short.shape[1] if hasattr(atoms.searched, "short") else whole


def measure(patches: np.ndarray, dictionary: np.ndarray, basis: np.ndarray, rounds: int) -> dict:
    gemm, memory = rates(patches, dictionary, rounds)
    rows = {}
    for name, (work, operations, n_bytes) in kernels(patches, dictionary, basis).items():
        s = least(work, rounds) / len(patches)
        rows[name] = {
            "microseconds": 1e6 * s,
            "of_gemm_rate": operations / s / gemm,
            "of_memory_rate": n_bytes / s / memory,
        }
    return {
        "atoms": len(dictionary),
        "components": basis.shape[1],
        "gemm_gflops": gemm / 1e9,
        "memory_gbytes_s": memory / 1e9,
        "kernels": rows,
    }


def main() -> None:
    options = arguments(__doc__).parse_args()
    every = textured_patches(options.scan, options.patches + 5 * max(options.atoms))
    with threadpoolctl.threadpool_limits(1):
        rows = [
            measure(every[: options.patches], *learned_dictionary(every[options.patches :][: 5 * k], k), options.rounds)
            for k in options.atoms
        ]
    if options.json:
        print(json.dumps({"rows": rows}))
        return
    for row in rows:
        print(
            f"{row['atoms']} atoms, {row['components']} components: GEMM {row['gemm_gflops']:.0f} GFLOP/s, "
            f"memory {row['memory_gbytes_s']:.1f} GB/s"
        )
        for name, found in row["kernels"].items():
            print(
                f"  {name:<26} {found['microseconds']:8.2f} us a patch, {found['of_gemm_rate']:6.0%} of the GEMM's rate, "
                f"{found['of_memory_rate']:6.0%} of memory's"
            )


if __name__ == "__main__":
    main()
