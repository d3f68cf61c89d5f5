"""What a dictionary learned from more splats than the pilot's does for splats that it was learned from, and for the
others.

Splats that a dictionary was learned from do better with it than others, and the others worse than with the best one, by
as much; both gaps shrink as patches an atom grow. What the pilot's two sorts of splats lose and take tells the gaps,
octave by octave of contrast, for the training set prefers the higher ones.

The multiplier of an atom is set such that the splats learned from have the error that the target promises. Theirs is
too good in the pilot by more than in the job, so the job's multiplier is lower: fewer errors, more atoms. With a budget
in place of a target the multiplier is such that atoms are as many.

A dictionary gains in proportion to the logarithm of the passes that it was learned in, which the pilot's curve tells:
on `monstree` 40 passes gained 0.75 dB after the fourth, where the second to the fourth tell 0.63.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.numerics.hashing import uniform_hash
from pipeline.stages.texture.contrast_octaves import octave_of
from pipeline.stages.texture.texels import points_of
from pipeline.stages.texture.training import TrainingSet
from pipeline.summaries import Ladder
from storage.work import arrays, work

CARRIES_OVER = (
    0.85  # of what the pilot's curve tells: part of its gain is that its patches, which are few, are learned by heart
)
LEAST_COMPARED = 50  # splats of an octave on either side


def membership(stage: TrainingSet, folder: Path, held: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of every splat: whether its average colour leaves it unsettled, whether it is learned from, where a share `held`
    of the training set is not, and its octave."""
    energy = arrays.read(stage.colors, "energy")
    octave, share = octave_of(energy), np.array(work.read_json(folder / "share.json")["share"])
    active = energy > stage.tolerance
    draw = uniform_hash(points_of(stage.patches), stage.seed)
    return active, active & (draw < (1 - held) * share[octave]), octave


@dataclass(frozen=True)
class Outcome:
    """Of the splats that their average colour does not settle."""

    error: float  # summed
    n_atoms: float


@dataclass(frozen=True)
class Sorts:
    """The pilot's unsettled splats; rows correspond."""

    octave: np.ndarray  # (n,)
    learned: np.ndarray  # (n,) bool: whether the dictionary was learned from it
    error: np.ndarray  # (n,)
    n_atoms: np.ndarray  # (n,)


@dataclass(frozen=True)
class Slope:
    """Of the ladder of multipliers where the pilot's multiplier lies; None where it is the least, and no job's is
    lower."""

    atoms_an_error: float | None  # d log(atoms) / d log(error), negative


def gain_of_passes(curve_db: list[float], n_passes: int, least_gain_db: float) -> float:
    """What the dictionary of `n_passes` of learning gains, in dB, over that of a pilot with such a curve, whose first
    figure is the seed's, which says nothing. Learning ends early where a pass would gain less than `least_gain_db`."""
    n = len(curve_db)
    if n < 3 or n_passes <= n:
        return 0.0
    a_fold = max(0.0, curve_db[-1] - curve_db[1]) / np.log(n - 1)
    if least_gain_db:
        n_passes = min(n_passes, a_fold / least_gain_db)
    return float(CARRIES_OVER * a_fold * max(0.0, np.log(n_passes / n)))


def outcome_in_job(
    sorts: Sorts, in_job: np.ndarray, shrink: float, slope: Slope, keeps_atoms: bool = False, gain_db: float = 0.0
) -> Outcome:
    """What the job's splats lose and take, scaled to as many as the pilot has. `in_job`, by octave, is the share that
    the job learns from; `shrink` what is left of the pilot's gaps; `gain_db` by how much its dictionary is better at
    equal atoms."""
    learned, others = (
        {o: e * 10 ** (-gain_db / 10) for o, e in sort.items()} for sort in _by_octave(sorts, "error", shrink)
    )
    error, n_atoms = (
        _mixed(sorts, in_job, learned, others),
        _mixed(sorts, in_job, *_by_octave(sorts, "n_atoms", shrink)),
    )
    if not slope.atoms_an_error:
        return Outcome(error, n_atoms)
    if keeps_atoms:
        fall = (sorts.n_atoms.sum() / max(1e-30, n_atoms)) ** (1 / slope.atoms_an_error)
    else:
        fall = _learned_error(sorts) / max(1e-30, _weighted(sorts, learned))
    return Outcome(fall * error, n_atoms * fall**slope.atoms_an_error)


def slope_at(multiplier: float, ladder: Ladder, least: float) -> Slope:
    """Of the summary of `Multipliers`; `least` is the lowest multiplier that any target makes it."""
    multipliers, error, n_atoms = map(np.array, (ladder.multiplier, ladder.error, ladder.n_atoms))
    if multiplier <= least * 1.001 or min(error.min(), n_atoms.min()) <= 0:
        return Slope(None)
    order = np.argsort(multipliers)
    at = int(np.clip(np.searchsorted(multipliers[order], multiplier), 1, len(multipliers) - 1))
    below, above = order[at - 1], order[at]
    rise = np.log(error[above] / error[below])
    return Slope(float(np.log(n_atoms[above] / n_atoms[below]) / rise) if rise > 1e-9 else 0.0)


def _by_octave(sorts: Sorts, name: str, shrink: float) -> tuple[dict[int, float], dict[int, float]]:
    """Means of the job's splats that it learns from, and of its others."""
    values, learned, others = getattr(sorts, name), {}, {}
    for octave in np.unique(sorts.octave):
        here = sorts.octave == octave
        inside, outside = values[here & sorts.learned], values[here & ~sorts.learned]
        if min(len(inside), len(outside)) >= LEAST_COMPARED:
            middle, half = (outside.mean() + inside.mean()) / 2, (outside.mean() - inside.mean()) / 2 * shrink
        else:
            middle, half = values[here].mean(), 0.0
        learned[int(octave)], others[int(octave)] = middle - half, middle + half
    return learned, others


def _learned_error(sorts: Sorts) -> float:
    """Of all splats, were those that the pilot did not learn from as those that it did."""
    return _weighted(sorts, _by_octave(sorts, "error", 1.0)[0])


def _weighted(sorts: Sorts, mean: dict[int, float]) -> float:
    return float(sum((sorts.octave == octave).sum() * value for octave, value in mean.items()))


def _mixed(sorts: Sorts, in_job: np.ndarray, learned: dict[int, float], others: dict[int, float]) -> float:
    return _weighted(sorts, {o: in_job[o] * learned[o] + (1 - in_job[o]) * others[o] for o in learned})
