"""Weight levels that are learned in the loop."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from pipeline.coding.levels import learn_levels
from pipeline.coding.omp import pursue_patches
from pipeline.coding.quantise import train_weight_levels
from tests.pipeline.coding.test_beam import alike_atoms

RANKS, N_LEVELS, MULTIPLIER = 6, 8, 0.1


@cache
def _case():
    """Atoms, patches of few of them to learn from, others, and the levels of weights that are not rounded."""
    rng = np.random.default_rng(0)
    atoms = alike_atoms(rng, 96, 192)
    weight = rng.laplace(0, 1, (1200, 96)) * (rng.random((1200, 96)) < 0.04) * np.exp(rng.normal(0, 1, (1200, 1)))
    patches = (weight @ atoms + 0.02 * rng.standard_normal((1200, 192))).astype(np.float32)
    found = pursue_patches(patches[:800], atoms, max_atoms=RANKS, multiplier=MULTIPLIER).codes
    weights = [found.weight[found.n_atoms > rank, rank] for rank in range(RANKS)]
    return atoms, patches[:800], patches[800:], train_weight_levels(weights, N_LEVELS)


def _coded(patches, levels, pursuit):
    options = {"max_atoms": RANKS, "multiplier": MULTIPLIER, "weight_levels": levels, "pursuit": pursuit}
    return pursue_patches(patches, _case()[0], **options)


def _cost(patches, levels, pursuit):
    found = _coded(patches, levels, pursuit)
    return found.residual.sum() + MULTIPLIER * found.codes.n_atoms.sum()


def _learned(pursuit, stands_for=None, levels=None):
    atoms, patches, _, first = _case()
    stands_for = np.ones(len(patches)) if stands_for is None else stands_for
    levels = first if levels is None else levels
    return learn_levels(levels, patches, atoms, stands_for, lambda tried: _coded(patches, tried, pursuit), MULTIPLIER)


def test_levels__learned_in_the_loop_leave_less_of_other_patches():
    _, patches, others, levels = _case()
    learned = _learned("2x2")
    assert learned.shape == levels.shape and learned.dtype == np.float32 and (np.diff(learned, axis=1) >= 0).all()
    assert _cost(others, learned, "2x2") < 0.9 * _cost(others, levels, "2x2")


@pytest.mark.parametrize("pursuit", ["omp", "2x2"])
def test_levels__never_do_worse_on_what_they_learn_from(pursuit):
    _, patches, _, levels = _case()
    for first in (levels, levels[:, ::7]):
        assert _cost(patches, _learned(pursuit, levels=first), pursuit) <= _cost(patches, first, pursuit)


def test_levels__patches_that_stand_for_many_count_as_many():
    _, patches, _, _ = _case()
    stands_for = np.where(np.arange(len(patches)) < 400, 1e6, 1.0)
    for_the_first, for_the_last = _learned("2x2", stands_for), _learned("2x2", 1 / stands_for)
    assert _cost(patches[:400], for_the_first, "2x2") < 0.98 * _cost(patches[:400], for_the_last, "2x2")
    assert (_learned("2x2", 1000 * stands_for) == for_the_first).mean() > 0.9


def test_levels__one_that_no_weight_takes_stays():
    far = np.concatenate([_case()[3], np.full((RANKS, 1), 1e4, np.float32)], axis=1)
    assert (_learned("2x2", levels=far)[:, -1] == 1e4).all()
