"""What does a dictionary update cost beside the coding pass it follows?

    python -m benchmarks.dictionary_update SCAN [--atoms 256 4096] [--patches 8192] [--json]

One thread, as in a task of the pipeline, coding at 40 dB with at most 8 atoms: a coding pass, the sums of the update,
and the update itself, in turns; in components, where the pipeline learns, and on whole patches (certified search). The
paper's update takes 3 times its coding pass.
"""

from __future__ import annotations

import json

import numpy as np
import threadpoolctl

from benchmarks.patches import arguments, in_turns, learned_dictionary, textured_patches
from pipeline.coding.ksvd import block_sums, updated_dictionary
from pipeline.coding.search.choice import ready_for
from pipeline.coding.subspace import project
from pipeline.numerics.accuracy import squared_error_at
from pipeline.stages.texture.atoms import Atoms


def measure(
    where: str, patches: np.ndarray, dictionary: np.ndarray, tolerance: float | np.ndarray, rounds: int
) -> dict:
    atoms = Atoms(ready_for("certified", dictionary))
    found = atoms.pursue(patches, 8, tolerance)
    sums = block_sums(patches, dictionary, found)
    taken = in_turns(
        {
            "coding pass": lambda: atoms.pursue(patches, 8, tolerance),
            "sums": lambda: block_sums(patches, dictionary, found),
            "update": lambda: updated_dictionary(dictionary, sums),
        },
        rounds,
    )
    return {
        "where": where,
        "atoms": len(dictionary),
        "patches": len(patches),
        "values": patches.shape[1],
        "seconds": taken,
        "sums_to_coding": taken["sums"] / taken["coding pass"],
        "update_to_coding": taken["update"] / taken["coding pass"],
        "coding_microseconds_a_patch": 1e6 * taken["coding pass"] / len(patches),
    }


def both(patches: np.ndarray, dictionary: np.ndarray, basis: np.ndarray, rounds: int) -> list[dict]:
    tolerance = squared_error_at(40.0, patches.shape[1])
    coefficients, rest = project(patches, basis)
    short = dictionary @ basis
    short /= np.linalg.norm(short, axis=1, keepdims=True)
    return [
        measure("in components", coefficients, short, np.maximum(tolerance - rest, 0), rounds),
        measure("whole patches", patches, dictionary, tolerance, rounds),
    ]


def main() -> None:
    options = arguments(__doc__).parse_args()
    every = textured_patches(options.scan, options.patches + 5 * max(options.atoms))
    rows = []
    with threadpoolctl.threadpool_limits(1):
        for n_atoms in options.atoms:
            made = learned_dictionary(every[options.patches :][: 5 * n_atoms], n_atoms)
            rows += both(every[: options.patches], *made, options.rounds)
    if options.json:
        print(json.dumps({"rows": rows}))
        return
    for row in rows:
        print(
            f"{row['atoms']} atoms, {row['patches']} patches, {row['where']} ({row['values']} values): coding "
            f"{row['coding_microseconds_a_patch']:.1f} us a patch; of it sums {row['sums_to_coding']:.3f} (once a block), "
            f"update {row['update_to_coding']:.3f} (once an iteration)"
        )


if __name__ == "__main__":
    main()
