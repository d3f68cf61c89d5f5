"""How fast is OMP, against other libraries and against the one GEMM Y D^T?

    python -m benchmarks.sparse_coding SCAN [--atoms 256 4096] [--patches 8192] [--json]

Patches of 3,072 float32 values, 8 atoms, no cut-off, all cores. All run in turns in this process; what is printed are
medians and the ratios of them. What depends on the dictionary alone (its split, its Gram matrix) is made before, as a
stage of the pipeline does once for all its tasks; SPAMS makes its own. "in components" codes patches that are stored as
coefficients. SPAMS (`pip install spams-bin`) and scikit-learn are timed where they are installed; scikit-learn on 32 of
the patches at most.
"""

from __future__ import annotations

import json

import numpy as np

from benchmarks.patches import arguments, in_turns, learned_dictionary, textured_patches
from pipeline.coding.omp import pursue_patches
from pipeline.coding.search.choice import ready_for
from pipeline.execution.threads import available_cores

N_ATOMS = 8
SPAMS = "SPAMS omp"  # which is order-recursive: "ormp" is its equal, OMP leaves more


def peers(patches: np.ndarray, dictionary: np.ndarray) -> tuple[dict, dict[str, int], list[str]]:
    """What to time, how many patches each codes, and what is missing."""
    works, counts, missing = {}, {}, []
    try:
        import spams

        y, d = np.asfortranarray(patches.T), np.asfortranarray(dictionary.T)
        works[SPAMS] = lambda: spams.omp(y, d, L=N_ATOMS, eps=0.0, numThreads=-1)
        counts[SPAMS] = len(patches)
    except ImportError:
        missing.append("SPAMS is not installed (pip install spams-bin)")
    try:
        from sklearn.linear_model import orthogonal_mp_gram

        few, gram = patches[: min(32, len(patches) // 8)], dictionary @ dictionary.T
        works["scikit-learn orthogonal_mp_gram"] = lambda: orthogonal_mp_gram(
            gram, dictionary @ few.T, n_nonzero_coefs=N_ATOMS
        )
        counts["scikit-learn orthogonal_mp_gram"] = len(few)
    except ImportError:
        missing.append("scikit-learn is not installed (pip install scikit-learn)")
    return works, counts, missing


def ours(patches: np.ndarray, dictionary: np.ndarray, basis: np.ndarray) -> dict:
    """What to time of this project, each with what depends on the dictionary made before."""
    coefficients, short = patches @ basis, dictionary @ basis
    short /= np.linalg.norm(short, axis=1, keepdims=True)
    whole, ready, in_components = (
        ready_for("exact", dictionary),
        ready_for("certified", dictionary),
        ready_for("exact", short),
    )
    options = {"max_atoms": N_ATOMS, "n_threads": available_cores()}
    return {
        "exact": lambda: pursue_patches(patches, whole, search="exact", **options),
        "certified": lambda: pursue_patches(patches, ready, search="certified", **options),
        "approximate": lambda: pursue_patches(patches, ready, search="approximate", **options),
        "ormp, certified": lambda: pursue_patches(patches, ready, search="certified", pursuit="ormp", **options),
        "in components": lambda: pursue_patches(coefficients, in_components, search="exact", **options),
    }


def measure(patches: np.ndarray, dictionary: np.ndarray, basis: np.ndarray, rounds: int) -> dict:
    works = {"GEMM Y D^T": lambda: patches @ dictionary.T} | ours(patches, dictionary, basis)
    others, counts, missing = peers(patches, dictionary)
    processor: dict[str, float] = {}
    taken = in_turns(works | others, rounds, processor)
    rate = {name: counts.get(name, len(patches)) / s for name, s in taken.items()}
    cost = {name: 1e6 * s / counts.get(name, len(patches)) for name, s in processor.items()}
    error = {
        name: float(works[name]().residual.sum()) for name in ("exact", "certified", "approximate", "ormp, certified")
    }
    if SPAMS in others:
        decoded = (dictionary.T @ others[SPAMS]().toarray()).T
        error[SPAMS] = float(((patches - decoded).astype(np.float64) ** 2).sum())
    return {
        "atoms": len(dictionary),
        "patches": len(patches),
        "components": basis.shape[1],
        "splats_per_second": rate,
        "processor_microseconds_a_splat": cost,
        "certified_times_by_processor": {name: c / cost["certified"] for name, c in cost.items()},
        "certified_times": {name: rate["certified"] / r for name, r in rate.items()},
        "psnr_below_exact_db": {s: 10 * float(np.log10(e / error["exact"])) for s, e in error.items()},
        "missing": missing,
    }


def main() -> None:
    options = arguments(__doc__).parse_args()
    every = textured_patches(options.scan, options.patches + 5 * max(options.atoms))
    rows = []
    for n_atoms in options.atoms:
        made = learned_dictionary(every[options.patches :][: 5 * n_atoms], n_atoms)
        rows.append(measure(every[: options.patches], *made, options.rounds))
    if options.json:
        print(json.dumps({"cores": available_cores(), "rows": rows}))
        return
    for row in rows:
        print(f"{row['atoms']} atoms, {row['patches']} patches, {available_cores()} cores")
        for name, rate in row["splats_per_second"].items():
            lost = row["psnr_below_exact_db"].get(name)
            print(
                f"  {name:<32} {rate:10,.0f} splats/s   certified is {row['certified_times'][name]:6.2f} times as fast"
                f"   {row['processor_microseconds_a_splat'][name]:8.1f} us of processors, "
                f"{row['certified_times_by_processor'][name]:6.2f} times certified's"
                + (f"   {lost:+.4f} dB below exact" if lost is not None else "")
            )
        for line in row["missing"]:
            print(f"  {line}")


if __name__ == "__main__":
    main()
