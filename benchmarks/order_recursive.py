"""Order-recursive pursuit beside SPAMS' `omp`, which is order-recursive too: residuals and times at equal atoms, atoms
and times at equal error.

    python -m benchmarks.order_recursive SCAN [--atoms 256 4096] [--counts 2 4 8] [--decibels 30 35 40]
        [--patches 8192] [--rounds 5] [--json]

Whole patches of 3,072 values, exact weights. At equal atoms there is no cut-off; at equal error a patch is done when
its squared residual is that of so many decibels (`tolerance` here, `eps` there), or when it has 24 atoms. A dictionary that is learned, and one of patches as atoms. In
turns in one process; times are processor microseconds of all threads a patch, medians of the rounds; what depends on
the dictionary alone is made before on both sides, but what SPAMS makes inside. Of 4,096 atoms a quarter of the patches
is coded.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable

import numpy as np

from benchmarks.patches import arguments, learned_dictionary, textured_patches
from pipeline.coding.omp import Pursuit, pursue_patches
from pipeline.coding.search.choice import ready_for
from pipeline.execution.threads import available_cores
from pipeline.numerics.accuracy import squared_error_at

PAUSE_S = 0.05  # threads of a library go on spinning for 20 ms
QUARTER_FROM = 1024  # atoms
MOST_ATOMS = 24  # at equal error


def measure(patches: np.ndarray, dictionary: np.ndarray, rounds: int, most: int, tolerance: float = 0.0) -> dict:
    """What each leaves and takes with at most so many atoms a patch, each patch done at a squared residual."""
    import spams

    ready = ready_for("certified", dictionary)
    y, d = np.asfortranarray(patches.T), np.asfortranarray(dictionary.T)
    options = {"search": "certified", "pursuit": "ormp", "n_threads": available_cores()}

    def ours() -> Pursuit:
        return pursue_patches(patches, ready, max_atoms=most, tolerance=tolerance, **options)

    def theirs() -> object:
        return spams.omp(y, d, L=most, eps=tolerance, numThreads=-1)

    us = {"ours": _median_us(ours, len(patches), rounds), "spams": _median_us(theirs, len(patches), rounds)}
    found, codes = ours(), theirs()
    left = ((patches - (dictionary.T @ codes.toarray()).T).astype(np.float64) ** 2).sum(axis=1)
    return {
        "above_db": 10 * float(np.log10(found.residual.sum() / left.sum())),
        "atoms_a_patch": {"ours": float(found.codes.n_atoms.mean()), "spams": codes.nnz / len(patches)},
        "short_of_the_error": {
            "ours": float((found.residual > 1.001 * tolerance).mean()),
            "spams": float((left > 1.001 * tolerance).mean()),
        },
        "us": us,
        "times": us["spams"] / us["ours"],
    }


def _median_us(work: Callable[[], object], n: int, rounds: int) -> float:
    taken = []
    for _ in range(rounds + 1):
        time.sleep(PAUSE_S)
        begun = time.process_time()
        work()
        taken.append(time.process_time() - begun)
    return 1e6 * float(np.median(taken[1:])) / n


def _at_equal_atoms(row: dict) -> str:
    return (
        f"{row['atoms']:>5} {row['dictionary']:<8} {row['count']} atoms: {row['above_db']:+.4f} dB above SPAMS, "
        f"{row['us']['ours']:6.1f} us for {row['us']['spams']:7.1f}, {row['times']:5.2f} times as fast"
    )


def _at_equal_error(row: dict) -> str:
    taken, short = row["atoms_a_patch"], row["short_of_the_error"]
    return (
        f"{row['atoms']:>5} {row['dictionary']:<8} {row['db']:g} dB: {taken['ours']:.3f} atoms for {taken['spams']:.3f}, "
        f"{taken['ours'] / taken['spams']:.4f} times SPAMS', short of the error {short['ours']:.1%} for {short['spams']:.1%}, "
        f"{row['us']['ours']:6.1f} us for {row['us']['spams']:7.1f}, {row['times']:5.2f} times as fast"
    )


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--counts", type=int, nargs="*", default=[2, 4, 8])
    parser.add_argument("--decibels", type=float, nargs="*", default=[30.0, 35.0, 40.0])
    options = parser.parse_args()
    every = textured_patches(options.scan, options.patches + 5 * max(options.atoms))
    rows = []
    for n_atoms in options.atoms:
        n = options.patches // (4 if n_atoms > QUARTER_FROM else 1)
        others = every[options.patches :][: 5 * n_atoms]
        of_patches = others[:n_atoms] / np.linalg.norm(others[:n_atoms], axis=1, keepdims=True)
        for name, dictionary in (("learned", learned_dictionary(others, n_atoms)[0]), ("patches", of_patches)):
            known = {"atoms": n_atoms, "dictionary": name}
            for count in options.counts:
                rows.append(known | {"count": count} | measure(every[:n], dictionary, options.rounds, count))
                if not options.json:
                    print(_at_equal_atoms(rows[-1]), flush=True)
            for db in options.decibels:
                tolerance = squared_error_at(db, every.shape[1])
                rows.append(known | {"db": db} | measure(every[:n], dictionary, options.rounds, MOST_ATOMS, tolerance))
                if not options.json:
                    print(_at_equal_error(rows[-1]), flush=True)
    if options.json:
        print(json.dumps({"cores": available_cores(), "rows": rows}))


if __name__ == "__main__":
    main()
