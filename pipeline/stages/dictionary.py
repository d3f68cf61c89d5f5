"""Patches -> dictionary: a random start, then k-SVD, one stage an iteration."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.coding.ksvd import Sums, block_sums, initial_dictionary, merge_in_order, updated_dictionary
from pipeline.stages.atoms import load_atoms, store_atoms
from pipeline.stages.training import training_patches
from storage import arrays, work


@dataclass(frozen=True)
class DictionarySeed:
    """One task. Arrays: those of `atoms`."""

    training: Path
    n_atoms: int
    seed: int
    name = "dictionary-seed"

    def init(self, folder: Path) -> int:
        return 1

    def run(self, folder: Path, index: int) -> dict:
        n_tasks = work.summary(self.training)["n_tasks"]
        share = -(-2 * self.n_atoms // n_tasks)  # twice as many as needed: twins are passed over
        pool = []
        for task in range(n_tasks):
            patches = training_patches(self.training, task)
            pool.append(patches[np.random.default_rng([self.seed, task]).permutation(len(patches))[:share]])
        dictionary = initial_dictionary(np.concatenate(pool), self.n_atoms, self.seed)
        store_atoms(folder, dictionary)
        return {"n_atoms": len(dictionary)}

    def finalise(self, folder: Path, results: list[dict]) -> dict:
        return results[0]


@dataclass(frozen=True)
class KsvdUpdate:
    """One iteration: a task codes one part of the training set and sums it; finalise merges and updates.

    Arrays: those of `atoms`.
    """

    training: Path
    previous: Path
    max_atoms: int
    tolerance: float
    iteration: int
    name = "ksvd-update"

    def init(self, folder: Path) -> int:
        return work.summary(self.training)["n_tasks"]

    def run(self, folder: Path, index: int) -> dict:
        atoms = load_atoms(self.previous)
        patches = training_patches(self.training, index)
        pursuit = atoms.pursue(patches, self.max_atoms, self.tolerance)
        sums = block_sums(patches, atoms.dictionary, pursuit)
        np.savez(folder / f"sums-{index}.npz", **vars(sums))
        return {"n_splats": len(patches), "n_atoms_used": int(pursuit.codes.n_atoms.sum())}

    def finalise(self, folder: Path, results: list[dict]) -> dict:
        sums = merge_in_order(lambda i: _load_sums(folder, i), 0, len(results))
        dictionary, n_replaced = updated_dictionary(arrays.read(self.previous, "dictionary"), sums)
        store_atoms(folder, dictionary)
        for i in range(len(results)):
            (folder / f"sums-{i}.npz").unlink()
        return {"squared_error": sums.error, "n_patches": sums.n_patches, "n_replaced": n_replaced,
                "n_atoms_used": sum(r["n_atoms_used"] for r in results)}


def _load_sums(folder: Path, index: int) -> Sums:
    with np.load(folder / f"sums-{index}.npz") as stored:
        fields = {name: stored[name] for name in stored.files}
    return Sums(**{**fields, "error": float(fields["error"]), "n_patches": int(fields["n_patches"])})
