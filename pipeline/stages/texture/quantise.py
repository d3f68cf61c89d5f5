"""The dictionary in bytes, and the weight levels that suit it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.coding.grid import AtomForm, coefficients_of_texels, texels_of
from pipeline.coding.levels import learn_levels
from pipeline.coding.omp_kernels import squared_norms
from pipeline.coding.quantise import (
    dequantise_atoms,
    quantise_atoms,
    train_weight_levels,
    uniform_weight_levels,
)
from pipeline.coding.subspace import lift
from pipeline.stages.texture.atoms import load_atoms, store_atoms
from pipeline.stages.texture.training import (
    TrainingPart,
    n_tasks_of,
    stands_for,
    training_part,
    training_share,
)
from pipeline.summaries import InParts, Quantised
from storage.packed.dictionaries.levels import levels_of
from storage.packed.dictionaries.shipped import shipped
from storage.packed.schema import MIP_SIZES, PATCH_SIZE
from storage.work import arrays, work

IN_COMPONENTS = "in-components"
LEARNED_FROM = 2048  # patches, for weight levels: 4,096 gave 0.00 dB more


@dataclass(frozen=True)
class PartQuantised:
    """What a task tells of its patches."""

    n_splats: int
    squared_error: float


@dataclass(frozen=True)
class Quantisation:
    """A task a part of the training set: it is coded with exact weights by the atoms as they will be decoded, less what
    of them lies outside the components.

    Arrays: those of the packed file's dictionary (atoms_<s>, atom_scale, weight_levels), and those of `atoms` for the
    decoded atoms, and in a folder `in-components` for what of them the components hold.
    """

    training: Path  # in components
    learned: Path | None  # None: atoms are those that ship with the program
    max_atoms: int
    tolerance: float
    weight_bits: int
    learned_array: str = "dictionary"
    multiplier: float = 0.0
    form: AtomForm | None = (
        None  # None: in components, atoms are learned from whole patches and have even weight levels
    )
    shipped: str = ""  # the name of these
    pursuit: str = ""  # that of `Encode`, for which levels are then learned in the loop
    chosen: Path | None = None  # and the training set, which knows how many a patch stands for
    share: float = 1.0  # of the patches of each part, the first
    name = "quantise"

    def init(self, folder: Path) -> int:
        if self.learned is None:
            texels, scale = self._of_shipped(folder)
        else:
            learned = arrays.read(self.learned, self.learned_array)
            make = self._of_components if self.form is None else self._of_coefficients
            texels, scale = make(folder, learned)
        contents = {"atom_scale": scale}
        sizes = MIP_SIZES if self.form is None else MIP_SIZES[MIP_SIZES.index(self.form.size) :]
        finest = texels.reshape(-1, sizes[0], sizes[0], 3)
        contents |= {f"atoms_{s}": level for s, level in zip(sizes, levels_of(finest, sizes))}
        for name, rows in contents.items():
            arrays.store(folder, name, rows, (4096, *rows.shape[1:]))
        return n_tasks_of(self.training, self.share)

    def _of_components(self, folder: Path, learned: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        basis = arrays.read(self.training, "basis")
        texels, scale = quantise_atoms(lift(learned, basis))
        decoded = dequantise_atoms(texels, scale)
        store_atoms(folder, decoded)
        short = decoded @ basis
        store_atoms(folder / IN_COMPONENTS, short / np.linalg.norm(short, axis=1, keepdims=True))
        return texels, scale

    def _of_coefficients(self, folder: Path, learned: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        texels, _ = quantise_atoms(texels_of(learned, self.form.size))
        decoded = coefficients_of_texels(texels, self.form.size).astype(np.float64)
        scale = (1 / np.linalg.norm(decoded, axis=1)).astype(np.float32)  # such that what is shown is a unit vector
        store_atoms(folder, (decoded * scale[:, None]).astype(np.float32), self.form)
        return texels, scale

    def _of_shipped(self, folder: Path) -> tuple[np.ndarray, np.ndarray]:
        found = shipped(self.shipped)
        texels = found.texels.reshape(len(found.texels), -1)
        store_atoms(folder, coefficients_of_texels(texels, self.form.size) * found.scale[:, None], self.form)
        return texels, found.scale

    def run(self, folder: Path, index: int) -> PartQuantised:
        patches, rest = training_share(self.training, index, self.share)
        atoms = load_atoms(folder / IN_COMPONENTS if self.form is None else folder)
        found = atoms.pursue(patches, self.max_atoms, np.maximum(self.tolerance - rest, 0), multiplier=self.multiplier)
        codes = found.codes
        work.write_parts(work.parts(folder) / f"weights-{index}.npz", weight=codes.weight, n_atoms=codes.n_atoms)
        return PartQuantised(n_splats=len(codes.n_atoms), squared_error=float((found.residual + rest).sum()))

    def _learned_in_the_loop(self, folder: Path, levels: np.ndarray) -> np.ndarray:
        n_parts = work.summary(self.training, InParts).n_tasks
        of_each = -(-LEARNED_FROM // n_parts)
        parts = []
        for index in range(n_parts):
            every = training_part(self.training, index)
            step = max(1, len(every.rest) // of_each)
            parts.append(TrainingPart(every.coefficients[::step].copy(), every.rest[::step].copy()))
        patches, rest = (np.concatenate(values) for values in zip(*parts))
        atoms = load_atoms(folder)
        return learn_levels(
            levels,
            patches,
            atoms.dictionary,
            stands_for(self.chosen, squared_norms(patches) + rest),
            lambda tried: atoms.pursue(patches, self.max_atoms, 0.0, tried, self.multiplier, pursuit=self.pursuit),
            self.multiplier,
        )

    def finalise(self, folder: Path, results: list[PartQuantised]) -> Quantised:
        samples: list[list[np.ndarray]] = [[] for _ in range(self.max_atoms)]
        for i in range(len(results)):
            with work.open_parts(work.parts(folder) / f"weights-{i}.npz") as stored:
                for rank in range(stored["weight"].shape[1]):
                    samples[rank].append(stored["weight"][stored["n_atoms"] > rank, rank])
        ranks = [np.concatenate(s) if s else np.empty(0, np.float32) for s in samples]
        train = uniform_weight_levels if self.form is None else train_weight_levels
        levels = train(ranks, 2**self.weight_bits)
        if self.pursuit:
            levels = self._learned_in_the_loop(folder, levels)
        arrays.store(folder, "weight_levels", levels.astype(np.float32, copy=False))
        return Quantised(
            n_atoms=arrays.layout_of(folder, "atom_scale").shape[0],
            atom_size=self.form.size if self.form else PATCH_SIZE,
            n_turns=self.form.n_turns if self.form else 1,
            squared_error=sum(r.squared_error for r in results),
        )
