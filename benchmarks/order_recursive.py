"""Order-recursive pursuit beside SPAMS' `omp`, which is order-recursive too: residuals and times at equal atoms.

    python -m benchmarks.order_recursive SCAN [--atoms 256 4096] [--counts 2 4 8] [--patches 8192] [--rounds 5] [--json]

Whole patches of 3,072 values, exact weights, no cut-off; a dictionary that is learned, and one of patches as atoms. In
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
from pipeline.coding.omp import pursue_patches
from pipeline.coding.search.choice import ready_for
from pipeline.execution.threads import available_cores

PAUSE_S = 0.05  # threads of a library go on spinning for 20 ms
QUARTER_FROM = 1024  # atoms


def measure(patches: np.ndarray, dictionary: np.ndarray, count: int, rounds: int) -> dict:
    """What each leaves and takes with `count` atoms a patch."""
    import spams

    ready = ready_for("certified", dictionary)
    y, d = np.asfortranarray(patches.T), np.asfortranarray(dictionary.T)

    def ours() -> float:
        options = {"max_atoms": count, "search": "certified", "pursuit": "ormp", "n_threads": available_cores()}
        return float(pursue_patches(patches, ready, **options).residual.sum())

    def theirs() -> object:
        return spams.omp(y, d, L=count, eps=0.0, numThreads=-1)

    us = {"ours": _median_us(ours, len(patches), rounds), "spams": _median_us(theirs, len(patches), rounds)}
    decoded = (dictionary.T @ theirs().toarray()).T
    left = float(((patches - decoded).astype(np.float64) ** 2).sum())
    return {
        "count": count,
        "above_db": 10 * float(np.log10(ours() / left)),
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


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--counts", type=int, nargs="+", default=[2, 4, 8])
    options = parser.parse_args()
    every = textured_patches(options.scan, options.patches + 5 * max(options.atoms))
    rows = []
    for n_atoms in options.atoms:
        n = options.patches // (4 if n_atoms > QUARTER_FROM else 1)
        others = every[options.patches :][: 5 * n_atoms]
        of_patches = others[:n_atoms] / np.linalg.norm(others[:n_atoms], axis=1, keepdims=True)
        for name, dictionary in (("learned", learned_dictionary(others, n_atoms)[0]), ("patches", of_patches)):
            for count in options.counts:
                found = measure(every[:n], dictionary, count, options.rounds)
                rows.append({"atoms": n_atoms, "dictionary": name, **found})
                if not options.json:
                    print(
                        f"{n_atoms:>5} {name:<8} {count} atoms: {found['above_db']:+.4f} dB above SPAMS, {found['us']['ours']:6.1f} us for "
                        f"{found['us']['spams']:7.1f}, {found['times']:5.2f} times as fast",
                        flush=True,
                    )
    if options.json:
        print(json.dumps({"cores": available_cores(), "rows": rows}))


if __name__ == "__main__":
    main()
