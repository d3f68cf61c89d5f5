"""What does a dictionary update cost beside the coding pass it follows?

    python -m benchmarks.dictionary_update SCAN [--atoms 256 4096] [--patches 8192] [--json]

One thread, as in a task of the pipeline, coding at 40 dB with at most 8 atoms: a coding pass (certified search), the
sums of the update, and the update itself, in turns. The paper's update takes 3 times its coding pass.
"""

from __future__ import annotations

import json

import numpy as np
import threadpoolctl

from benchmarks.patches import arguments, in_turns, some_dictionary, textured_patches
from pipeline.accuracy import squared_error_at
from pipeline.coding.certified import shorten
from pipeline.coding.ksvd import block_sums, updated_dictionary
from pipeline.coding.omp import pursue_patches


def measure(patches: np.ndarray, dictionary: np.ndarray, rounds: int) -> dict:
    split = shorten(dictionary) or dictionary
    options = {"max_atoms": 8, "tolerance": squared_error_at(40.0, patches.shape[1]), "search": "certified",
               "gram": dictionary @ dictionary.T if split is dictionary else None}
    found = pursue_patches(patches, split, **options)
    sums = block_sums(patches, dictionary, found)
    taken = in_turns({
        "coding pass": lambda: pursue_patches(patches, split, **options),
        "sums": lambda: block_sums(patches, dictionary, found),
        "update": lambda: updated_dictionary(dictionary, sums),
    }, rounds)
    return {"atoms": len(dictionary), "patches": len(patches), "seconds": taken,
            "sums_to_coding": taken["sums"] / taken["coding pass"],
            "update_to_coding": taken["update"] / taken["coding pass"]}


def main() -> None:
    options = arguments(__doc__).parse_args()
    every = textured_patches(options.scan, options.patches + 5 * max(options.atoms))
    rows = []
    with threadpoolctl.threadpool_limits(1):
        for n_atoms in options.atoms:
            dictionary = some_dictionary(every[options.patches :][: 5 * n_atoms], n_atoms)
            rows.append(measure(every[: options.patches], dictionary, options.rounds))
    if options.json:
        print(json.dumps({"rows": rows}))
        return
    for row in rows:
        print(f"{row['atoms']} atoms, {row['patches']} patches: coding {row['seconds']['coding pass']:.2f} s; of it "
              f"sums {row['sums_to_coding']:.2f} (once a block), update {row['update_to_coding']:.2f} (once an iteration)")


if __name__ == "__main__":
    main()
