"""From what the pilot's splats lose and take to what the job's do."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.summaries import Ladder
from services.processes.estimate_gaps import (
    CARRIES_OVER,
    LEAST_COMPARED,
    Outcome,
    Slope,
    Sorts,
    gain_of_passes,
    outcome_in_job,
    slope_at,
)

N = 1000
FLAT = Slope(None)
LADDER = Ladder((8.0, 4.0, 2.0), (4.0, 2.0, 1.0), (1.0, 2.0, 4.0))  # half the error for twice the atoms


def sorts(n_learned: int = 500, inside: float = 0.9, outside: float = 1.1) -> Sorts:
    """A thousand splats of one octave: those learned from lose `inside`, the others `outside`, and take as much in
    atoms."""
    learned = np.arange(N) < n_learned
    value = np.where(learned, inside, outside)
    return Sorts(np.full(N, 3), learned, value, 2 * value)


def in_job(share: float) -> np.ndarray:
    return np.full(26, share)


def test_gaps__a_pilot_that_is_the_job_needs_no_correction():
    found = outcome_in_job(sorts(), in_job(0.5), 1.0, slope_at(4.0, LADDER, 2.0))
    assert found == Outcome(pytest.approx(N * 1.0), pytest.approx(N * 2.0))


def test_gaps__a_job_that_learns_from_few_of_its_splats_has_mostly_others():
    assert outcome_in_job(sorts(), in_job(0.0), 1.0, FLAT).error == pytest.approx(N * 1.1)
    assert outcome_in_job(sorts(), in_job(1.0), 1.0, FLAT).error == pytest.approx(N * 0.9)


def test_gaps__shrink_to_the_middle_with_more_patches_an_atom():
    assert outcome_in_job(sorts(), in_job(0.0), 0.1, FLAT) == Outcome(pytest.approx(N * 1.01), pytest.approx(N * 2.02))


def test_gaps__a_smaller_optimism_lowers_the_multiplier():
    """The job's learned splats must come down from 0.99 to the pilot's 0.9: an eleventh less error, and as much more
    atoms."""
    found = outcome_in_job(sorts(), in_job(0.0), 0.1, slope_at(4.0, LADDER, 2.0))
    assert found.error == pytest.approx(N * 1.01 * 0.9 / 0.99)
    assert found.n_atoms == pytest.approx(N * 2.02 * 0.99 / 0.9)


def test_gaps__a_budget_keeps_the_atoms():
    found = outcome_in_job(sorts(), in_job(0.0), 0.1, slope_at(4.0, LADDER, 2.0), keeps_atoms=True)
    assert found == Outcome(pytest.approx(N * 1.01 * 1.01), pytest.approx(N * 2.0))


def test_gaps__octaves_with_few_splats_of_a_sort_have_none():
    few = sorts(n_learned=LEAST_COMPARED - 1, inside=0.0)
    assert outcome_in_job(few, in_job(1.0), 1.0, FLAT).error == pytest.approx(few.error.sum())


@pytest.mark.parametrize(("multiplier", "expected"), [(3.0, -1.0), (7.9, -1.0), (2.0, None), (1.0, None)])
def test_gaps__slope_is_that_of_the_ladder_and_none_at_its_end(multiplier, expected):
    found = slope_at(multiplier, LADDER, 2.0).atoms_an_error
    assert found == (expected if expected is None else pytest.approx(expected))


def test_passes__gain_by_the_logarithm_of_their_number():
    curve = [30.0, *(36.0 + 0.3 * np.log(update) for update in (1, 2, 3))]
    assert gain_of_passes(curve, 12, 0.0) == pytest.approx(CARRIES_OVER * 0.3 * np.log(3))
    assert gain_of_passes(curve, 4, 0.0) == 0  # as many as the pilot's
    assert gain_of_passes(curve, 1000, 0.02) == pytest.approx(
        CARRIES_OVER * 0.3 * np.log(0.3 / 0.02 / 4)
    )  # ends where a pass gains 0.02 dB
    assert gain_of_passes([30.0, 36.0], 12, 0.0) == 0 == gain_of_passes([30.0, 36.0, 35.0, 35.9], 12, 0.0)


def test_outcome__a_better_dictionary_lowers_the_error_or_the_atoms_that_bring_it():
    plain, better = (outcome_in_job(sorts(), in_job(0.5), 1.0, FLAT, gain_db=g) for g in (0.0, 1.0))
    assert better.error == pytest.approx(plain.error * 10**-0.1) and better.n_atoms == plain.n_atoms
    slope = slope_at(4.0, LADDER, 2.0)
    plain, better = (outcome_in_job(sorts(), in_job(0.5), 1.0, slope, gain_db=g) for g in (0.0, 1.0))
    assert better.error == pytest.approx(plain.error)
    assert better.n_atoms == pytest.approx(plain.n_atoms * 10 ** (0.1 * slope.atoms_an_error))
