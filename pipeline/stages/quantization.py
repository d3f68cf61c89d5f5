"""The dictionary in bytes, and the weight levels that suit it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.coding.quantize import dequantize_atoms, mip_levels, quantize_atoms, train_weight_levels
from pipeline.coding.subspace import lift
from pipeline.stages.atoms import load_atoms, store_atoms
from pipeline.stages.training import training_part
from storage import arrays, work
from storage.schema import MAX_ATOMS, MIP_SIZES

IN_COMPONENTS = "in-components"


@dataclass(frozen=True)
class Quantization:
    """A task a part of the training set: it is coded with exact weights by the atoms as they will be decoded, less what
    of them lies outside the components.

    Arrays: those of the packed file's dictionary (atoms_<s>, atom_scale, weight_levels), and those of `atoms` for the
    decoded atoms, and in a folder `in-components` for what of them the components hold.
    """

    training: Path  # in components
    learned: Path
    max_atoms: int
    tolerance: float
    weight_bits: int
    learned_array: str = "dictionary"
    name = "quantise"

    def init(self, folder: Path) -> int:
        basis = arrays.read(self.training, "basis")
        texels, scale = quantize_atoms(lift(arrays.read(self.learned, self.learned_array), basis))
        decoded = dequantize_atoms(texels, scale)
        store_atoms(folder, decoded)
        short = decoded @ basis
        store_atoms(folder / IN_COMPONENTS, short / np.linalg.norm(short, axis=1, keepdims=True))
        contents = {"atom_scale": scale}
        contents |= {f"atoms_{s}": level for s, level in zip(MIP_SIZES, mip_levels(texels))}
        for name, rows in contents.items():
            arrays.store(folder, name, rows, (4096, *rows.shape[1:]))
        return work.summary(self.training)["n_tasks"]

    def run(self, folder: Path, index: int) -> dict:
        patches, rest = training_part(self.training, index)
        found = load_atoms(folder / IN_COMPONENTS).pursue(patches, self.max_atoms, np.maximum(self.tolerance - rest, 0))
        codes = found.codes
        work.write_parts(work.parts(folder) / f"weights-{index}.npz", weight=codes.weight, n_atoms=codes.n_atoms)
        return {"n_splats": len(codes.n_atoms), "squared_error": float((found.residual + rest).sum())}

    def finalise(self, folder: Path, results: list[dict]) -> dict:
        samples: list[list[np.ndarray]] = [[] for _ in range(MAX_ATOMS)]
        for i in range(len(results)):
            with np.load(work.parts(folder) / f"weights-{i}.npz") as stored:
                for rank in range(stored["weight"].shape[1]):
                    samples[rank].append(stored["weight"][stored["n_atoms"] > rank, rank])
        ranks = [np.concatenate(s) if s else np.empty(0, np.float32) for s in samples]
        levels = train_weight_levels(ranks, 2**self.weight_bits)
        arrays.store(folder, "weight_levels", levels.astype(np.float32, copy=False))
        return {"n_atoms": arrays.opened(folder, "atom_scale").shape[0],
                "squared_error": sum(r["squared_error"] for r in results)}
