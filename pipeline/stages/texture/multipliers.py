"""What an atom must be worth: one Lagrange multiplier for all splats, such that the whole scan has the error that its
target promises.

The promise is the cut-off's: a splat that its average colour leaves below the target's error keeps what it has, every
other comes down to that error. Which splats then pay for it is left to the multiplier.

An atom is taken where it lowers a splat's squared error by more than the multiplier. With one multiplier for all, no
atom moved from one splat to another would lower the sum (a Lagrange multiplier, Everett 1963; Shoham and Gersho 1988),
where one cut-off for all spends atoms on splats that are hardly mended by them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.coding.beam.form import beam_of
from pipeline.coding.omp_kernels import squared_norms
from pipeline.stages.texture.atoms import load_atoms
from pipeline.stages.texture.training import HELD, held_part, stands_for
from pipeline.summaries import InParts, Ladder, Training
from storage.work import arrays, work

# Prices as shares of the squared error that a patch has at the target: where they lie on fountain_p11 and monstree
# with targets of 34 to 48 dB.
LADDER = tuple(2.0**-i for i in range(-1, 7))
# What an atom more a splat must gain between two multipliers, else the lower one is not taken, however far the target:
# splats have run out of atoms then. monstree with 8 atoms a splat and a target of 40 dB: 0.44, 0.24 and 0.14 dB on its
# last rungs.
LEAST_GAIN_DB = 0.3
# Of the target's error, the multiplier that dictionaries are learned with. fountain_p11, which is coded with 0.47, codes
# at equal dB: 0.13 1.2 % more bytes, and a third more time; 0.33 and 0.42 0.2 and 0.1 %.
WHILE_LEARNING = 0.23


def is_wide(pursuit: str) -> bool:
    """Whether a pursuit follows several supports: which, its multiplier decides (`beam.nodes.HOPE`), 0.1 dB in all."""
    beam = beam_of(pursuit)
    return beam is not None and beam.width > 1


@dataclass(frozen=True)
class PartPriced:
    """What a task tells of its patches: error and atoms at each multiplier, weighted, and the weight."""

    n_splats: int
    weight: float
    error: list[float]
    n_atoms: list[float]


@dataclass(frozen=True)
class Multipliers:
    """A task a part of the training set: those patches of it that nothing is learned from, the same splats however the
    scan is turned, are coded at every multiplier of the ladder.

    A patch counts as many times as its octave of contrast has others that were not chosen: octaves with few patches are
    in the set whole, and would else set the multiplier. Of fountain_p11 with 10,000 patches they raised the PSNR of
    `draft` by 0.4 dB above the one promised.
    """

    training: Path  # in the coder's coefficients
    chosen: Path  # the training set, which knows what share of each octave it is
    quantised: Path
    max_atoms: int
    tolerance: float  # the squared error of a patch at the target
    pursuit: str = "omp"  # that of `Encode`
    name = "multipliers"
    most_patches = HELD

    def init(self, folder: Path) -> int:
        return work.summary(self.training, InParts).n_tasks

    def run(self, folder: Path, index: int) -> PartPriced:
        patches, rest = held_part(self.training, index)
        weight = stands_for(self.chosen, squared_norms(patches) + rest)
        atoms, levels = load_atoms(self.quantised), arrays.read(self.quantised, "weight_levels")
        found, error, n_atoms = None, [], []
        for rung in reversed(LADDER):  # what is found at the lowest tells of all others, but where a beam is wide
            if found is None or is_wide(self.pursuit):
                multiplier = rung * self.tolerance
                found = atoms.pursue(patches, self.max_atoms, 0.0, levels, multiplier, pursuit=self.pursuit)
            taken = found.atoms_at(rung * self.tolerance)
            error.append(float(weight @ (found.path[np.arange(len(taken)), taken] + rest)))
            n_atoms.append(float(weight @ taken))
        error.reverse()
        n_atoms.reverse()
        return PartPriced(n_splats=len(patches), weight=float(weight.sum()), error=error, n_atoms=n_atoms)

    def finalise(self, folder: Path, results: list[PartPriced]) -> Ladder:
        weight = sum(r.weight for r in results) or 1.0
        error, n_atoms = (np.sum([getattr(r, k) for r in results], axis=0) / weight for k in ("error", "n_atoms"))
        multiplier = tuple(share * self.tolerance for share in LADDER)
        return Ladder(multiplier, tuple(error.tolist()), tuple(n_atoms.tolist()))


def multiplier_for(ladder: Ladder, training: Training) -> float:
    """The multiplier at which all patches together have the error that a cut-off promises; both are summaries.

    The least of the ladder that is worth its atoms where none is low enough: what a decibel then costs is out of
    proportion.
    """
    patch_error = training.cutoff_error / training.n_splats
    log_error, log_multiplier = np.log(np.maximum(_error_of_all(ladder, training), 1e-30)), np.log(ladder.multiplier)
    order = np.argsort(log_error)
    found = np.exp(np.interp(np.log(patch_error), log_error[order], log_multiplier[order]))
    return max(float(found), least_multiplier(ladder, training))


def least_multiplier(ladder: Ladder, training: Training) -> float:
    """The multiplier, found between the middles of the ladder's steps, down to which an atom more gains
    LEAST_GAIN_DB."""
    n_atoms = np.array(ladder.n_atoms) * training.n_active / training.n_splats
    fall_db = -10 * np.diff(np.log10(np.maximum(_error_of_all(ladder, training), 1e-30)))
    gain_db, log_multiplier = fall_db / np.maximum(np.diff(n_atoms), 1e-9), np.log(ladder.multiplier)
    middle = (log_multiplier[1:] + log_multiplier[:-1]) / 2
    bad = np.flatnonzero(gain_db < LEAST_GAIN_DB)
    if not len(bad):
        return float(np.exp(log_multiplier[-1]))
    i = bad[0]
    return float(np.exp(middle[0] if i == 0 else np.interp(LEAST_GAIN_DB, gain_db[[i, i - 1]], middle[[i, i - 1]])))


def _error_of_all(ladder: Ladder, training: Training) -> np.ndarray:
    """The error of a patch of the scan at each multiplier, those that their average settles among them."""
    return (np.array(ladder.error) * training.n_active + training.settled_energy) / training.n_splats
