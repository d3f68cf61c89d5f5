"""Patches in components, or as coefficients -> dictionary in the same: a random start, then k-SVD, one stage an
iteration."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.coding.grid import AtomForm
from pipeline.coding.ksvd import (
    Best,
    Sums,
    block_sums,
    initial_dictionary,
    judge,
    merge_in_order,
    merge_moments,
    next_trial,
)
from pipeline.stages.texture.atoms import load_atoms, store_atoms
from pipeline.stages.texture.training import first_coefficients, n_tasks_of, training_share
from pipeline.summaries import InParts, Seeded, Updated
from storage.work import arrays, work


@dataclass(frozen=True)
class DictionarySeed:
    """One task. Arrays: those of `atoms`."""

    training: Path
    n_atoms: int
    seed: int
    form: AtomForm = AtomForm()
    name = "dictionary-seed"

    def init(self, folder: Path) -> int:
        return 1

    def run(self, folder: Path, index: int) -> Seeded:
        n_tasks = work.summary(self.training, InParts).n_tasks
        share = -(-2 * self.n_atoms // n_tasks)  # twice as many as needed: patches that are alike are passed over
        pool = [first_coefficients(self.training, task, share) for task in range(n_tasks)]  # in an order by chance
        dictionary = initial_dictionary(np.concatenate(pool), self.n_atoms, self.seed)
        store_atoms(folder, dictionary, self.form)
        return Seeded(n_atoms=len(dictionary))

    def finalise(self, folder: Path, results: list[Seeded]) -> Seeded:
        return Seeded(results[0].n_atoms)


@dataclass(frozen=True)
class PartPursued:
    """What a task tells of its patches."""

    n_splats: int
    n_atoms_used: int
    quantised_error: float


@dataclass(frozen=True)
class KsvdUpdate:
    """One iteration: a task codes one part of the training set and sums it, or of some parts a `share`; finalise merges,
    judges and updates: by squared error, or with weight levels by that and the multiplier times atoms.

    Arrays: those of `atoms`, the next trial; before (k, d), the one just measured; best (k, d), the best of all
    measured so far on as many patches: errors of few and of all do not compare.
    """

    training: Path
    previous: Path
    max_atoms: int
    tolerance: float
    iteration: int
    multiplier: float = 0.0
    form: AtomForm = AtomForm()
    share: float = 1.0
    quantised_share: float = 1.0  # that quantising looks at, no more than `share`: its error is told besides
    quantised: Path | None = None  # whose weight levels patches are coded with; None: with exact weights
    pursuit: str = "omp"  # of pipeline.coding.beam.form
    name = "ksvd-update"

    def init(self, folder: Path) -> int:
        return n_tasks_of(self.training, self.share)

    def run(self, folder: Path, index: int) -> PartPursued:
        atoms = load_atoms(self.previous)
        patches, rest = training_share(self.training, index, self.share)
        levels, enough = self._levels, np.maximum(self.tolerance - rest, 0)
        found = atoms.pursue(patches, self.max_atoms, enough, levels, self.multiplier, pursuit=self.pursuit)
        pursuit = found.beside(rest)  # errors are those of whole patches
        sums = _of_atoms(block_sums(patches, atoms.dictionary, pursuit), self.form)
        if levels is not None:
            sums = replace(sums, error=sums.error + self.multiplier * int(found.codes.n_atoms.sum()))
        _store_sums(work.parts(folder), f"sums-{index}", sums)
        n_quantised = math.ceil(self.quantised_share / self.share * len(patches))
        return PartPursued(
            n_splats=len(patches),
            n_atoms_used=int(pursuit.codes.n_atoms.sum()),
            quantised_error=float(pursuit.residual[:n_quantised].sum()),
        )

    @property
    def _levels(self) -> np.ndarray | None:
        return arrays.read(self.quantised, "weight_levels") if self.quantised else None

    def finalise(self, folder: Path, results: list[PartPursued]) -> Updated:
        measured = arrays.read(self.previous, "dictionary")
        sums = _merged(work.parts(folder), len(results), measured.shape)
        best, accepted = judge(_best_of(self.previous, sums.n_patches, self.quantised is not None), measured, sums)
        quantised_error = sum(r.quantised_error for r in results)
        before = arrays.read(self.previous, "before") if arrays.exists(self.previous, "before") else None
        trial, n_replaced = next_trial(best, measured, before, sums)
        store_atoms(folder, trial, self.form)
        arrays.store(folder, "before", measured, (4096, measured.shape[1]))
        arrays.store(folder, "best", best.dictionary.astype(np.float32, copy=False), (4096, best.dictionary.shape[1]))
        _store_sums(folder, "best-sums", best.sums)
        return Updated(
            squared_error=best.sums.error,
            measured_error=sums.error,
            accepted=accepted,
            step=best.step,
            n_patches=sums.n_patches,
            n_replaced=n_replaced,
            n_atoms_used=sum(r.n_atoms_used for r in results),
            quantised_error=quantised_error if accepted else work.summary(self.previous, Updated).quantised_error,
            as_coded=self.quantised is not None,
        )


def _of_atoms(sums: Sums, form: AtomForm) -> Sums:
    """The sums of atoms from those of their turns: each turn's share is turned back and added."""
    if form.n_turns == 1:
        return sums
    gain, n_users = (values.reshape(-1, form.n_turns).sum(axis=1) for values in (sums.gain, sums.n_users))
    return replace(sums, moment=form.summed_back(sums.moment), gain=gain, n_users=n_users)


def _best_of(previous: Path, n_patches: int, as_coded: bool) -> Best | None:
    """What the iteration before judged best; None where it was the seed, or judged by other errors or patches."""
    if not arrays.exists(previous, "best"):
        return None
    judged = work.summary(previous, Updated)
    if (judged.n_patches, judged.as_coded) != (n_patches, as_coded):
        return None
    sums = _load_sums(previous, "best-sums")
    return Best(
        arrays.read(previous, "best"),
        replace(sums, moment=_moment(previous, "best-sums")),
        work.summary(previous, Updated).step,
    )


def _merged(folder: Path, n_tasks: int, shape: tuple[int, int]) -> Sums:
    """The sums of all tasks. Their moments, k x p each, stay on disk but for a range of atoms at a time."""
    moments = [_moment(folder, f"sums-{i}") for i in range(n_tasks)]
    sums = merge_in_order(lambda i: _load_sums(folder, f"sums-{i}"), 0, n_tasks)
    return replace(sums, moment=merge_moments(lambda i, atoms: moments[i][atoms], n_tasks, shape))


def _store_sums(folder: Path, name: str, sums: Sums) -> None:
    work.write_parts(folder / f"{name}.npz", **{k: v for k, v in vars(sums).items() if k != "moment"})
    work.write_part(_moment_path(folder, name), np.asarray(sums.moment))


def _load_sums(folder: Path, name: str) -> Sums:
    """All but the moment."""
    with work.open_parts(folder / f"{name}.npz") as stored:
        fields = {key: stored[key] for key in stored.files}
    nothing = np.empty((0, fields["worst_patch"].shape[1]))
    return Sums(**{**fields, "error": float(fields["error"]), "n_patches": int(fields["n_patches"]), "moment": nothing})


def _moment(folder: Path, name: str) -> np.ndarray:
    """The moment of stored sums, read where it is looked at."""
    return work.map_part(_moment_path(folder, name))


def _moment_path(folder: Path, name: str) -> Path:
    return folder / f"{name}-moment.npy"
