"""The residency manager on random paths: `python -m benchmarks.residency [N] [--from SEED] [--workers W]`, by default
10,000.

Every path is walked by the default policy, every tenth by the published one too; whatever does not hold is printed with
its seed (tests/renderer/residency/random_paths.py says what must). Exits 1 where anything did not.
"""

from __future__ import annotations

import argparse
import sys
import time
from concurrent.futures import ProcessPoolExecutor

from tests.renderer.residency.random_paths import keys_order, walk


def failures(seed: int) -> list[str]:
    """What did not hold on the path of this seed."""
    found = []
    for published in (False, True) if seed % 10 == 0 else (False,):
        try:
            walk(seed, published)
            keys_order(seed)
        except AssertionError as error:
            found.append(f"seed {seed}, policy {'paper' if published else 'default'}: {error}")
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("n", type=int, nargs="?", default=10_000)
    parser.add_argument("--from", dest="first", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    begun, n_failed = time.monotonic(), 0
    with ProcessPoolExecutor(options.workers) as pool:
        for found in pool.map(failures, range(options.first, options.first + options.n), chunksize=50):
            n_failed += len(found)
            for line in found:
                print(line, flush=True)
    print(f"{options.n:,} paths, {n_failed} failures, {time.monotonic() - begun:.0f} s")
    return 1 if n_failed else 0


if __name__ == "__main__":
    sys.exit(main())
