"""Dictionary learning where atoms occur together, do not occur, or cannot be told apart. Bounds as in
docs/NUMERICS.md."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pipeline.coding import ksvd
from pipeline.coding.coherence import MOST_COHERENCE
from pipeline.coding.ksvd import (
    MOMENTUM,
    Best,
    Sums,
    block_sums,
    initial_dictionary,
    judge,
    learn_dictionary,
    next_trial,
    updated_dictionary,
)
from pipeline.coding.omp import pursue_patches
from pipeline.execution.executors import SerialExecutor
from pipeline.execution.stage import run_stage
from pipeline.stages.texture import dictionary as stages
from pipeline.stages.texture import training
from pipeline.stages.texture.dictionary import DictionarySeed, KsvdUpdate
from pipeline.stages.texture.training import TrainingPart
from pipeline.summaries import InParts
from storage.work import arrays
from tests import reference
from tests.pipeline.coding.search.test_certified import normalised
from tests.pipeline.coding.test_ksvd import assert_sound, dense, planted
from tests.pipeline.coding.test_omp import unit_rows
from tests.pipeline.execution.test_stage import Heard

MONOTONE = 1e-6


def always_together(n_together: int, n: int = 1500, dim: int = 64, noise: float = 0.05, seed: int = 0) -> np.ndarray:
    """Patches of three groups of atoms, each group used as a whole with nearly equal weights."""
    rng = np.random.default_rng(seed)
    groups = [np.linalg.qr(rng.standard_normal((dim, n_together)))[0].T for _ in range(3)]
    weights = rng.uniform(0.8, 1.2, (n, 1)) + 0.05 * rng.standard_normal((n, n_together))
    return np.array([w @ groups[i % 3] + noise * rng.standard_normal(dim) for i, w in enumerate(weights)], np.float32)


def measured(patches, dictionary, most, tolerance=0.0):
    return block_sums(patches, dictionary, pursue_patches(patches, dictionary, max_atoms=most, tolerance=tolerance))


def curve_of(patches, n_atoms, most, iterations, seed=0):
    curve = []
    learned = learn_dictionary(
        patches,
        n_atoms,
        max_atoms=most,
        iterations=iterations,
        seed=seed,
        on_iteration=lambda i, error: curve.append(error),
    )
    return learned, np.array(curve)


def rises(curve: np.ndarray) -> np.ndarray:
    return np.diff(curve) / curve[:-1]


# --- atoms that occur together ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_together", [2, 4, 8])
def test_learning__side_by_side_updates_overshoot_right_after_the_update(n_together):
    """With codes kept as they are: all atoms at once against one after the other. The naive update, and its harm."""
    rng = np.random.default_rng(1)
    true = unit_rows(rng, n_together, 64).astype(float)
    weights = rng.uniform(0.9, 1.1, (400, 1)) * np.ones((400, n_together))
    patches = weights @ true
    start = true + 0.05 * rng.standard_normal(64)  # every atom off by the same: each mends it all
    before = reference.coded_error(patches, start, weights)
    at_once = reference.coded_error(patches, reference.side_by_side(patches, start, weights), weights)
    in_turn = reference.coded_error(patches, reference.in_turn(patches, start, weights), weights)
    assert in_turn <= before
    assert at_once > 0.9 * (n_together - 1) ** 2 * before - 1e-9 and (n_together == 2 or at_once > 2 * before)


@pytest.mark.parametrize(("n_together", "n_atoms"), [(8, 24), (8, 32)])
def test_learning__the_curve_never_rises_though_the_plain_update_makes_it(n_together, n_atoms):
    patches = always_together(n_together)
    dictionary, plain = initial_dictionary(patches, n_atoms, 0), []
    for _ in range(14):
        sums = measured(patches, dictionary, n_together)
        plain.append(sums.error / len(patches))
        dictionary, _ = updated_dictionary(dictionary, sums)
    learned, curve = curve_of(patches, n_atoms, n_together, 13)
    assert rises(np.array(plain)).max() > 1e-4  # the naive formulation
    assert rises(curve).max() <= MONOTONE
    assert curve[-1] <= min(plain) * 1.06  # 0.96 to 1.05 of 18 such sets
    assert_sound(learned)


def test_learning__what_is_returned_is_the_best_that_was_measured():
    patches = always_together(2)
    for iterations in (1, 5, 9):
        learned, curve = curve_of(patches, 8, 2, iterations)
        assert len(curve) == iterations + 1
        assert measured(patches, learned, 2).error / len(patches) == pytest.approx(curve[-1], rel=1e-9)


def test_learning__a_trial_that_did_much_worse_is_taken_back_and_atoms_go_half_as_far():
    rng = np.random.default_rng(2)
    patches, _ = planted(rng, 600, 12, 48)
    good = initial_dictionary(patches, 12, 0)
    best, accepted = judge(None, good, measured(patches, good, 3))
    assert accepted and best.step == 1
    worse = unit_rows(rng, 12, 48)
    bad = measured(patches, worse, 3)
    assert bad.error > 1.05 * best.sums.error
    kept, accepted = judge(best, worse, bad)
    assert not accepted and kept.dictionary is good and kept.step == 0.5
    assert judge(kept, worse, bad)[0].step == 0.25
    trial, n_replaced = next_trial(kept, worse, None, bad)
    moved = kept.sums.moment * 0.5 + kept.sums.gain[:, None] * good
    np.testing.assert_allclose(trial, moved / np.linalg.norm(moved, axis=1, keepdims=True), atol=1e-6)
    assert n_replaced == 0
    better, accepted = judge(kept, trial, measured(patches, trial, 3))
    assert accepted and better.step == 0.5 and better.sums.error < best.sums.error
    assert judge(better, trial, better.sums)[1]


@pytest.mark.parametrize(("rise", "goes_on"), [(0.0, True), (0.049, True), (0.051, False)])
def test_learning__goes_on_from_a_trial_that_did_a_little_worse(rise, goes_on):
    rng = np.random.default_rng(2)
    patches, _ = planted(rng, 600, 12, 48)
    good, other = initial_dictionary(patches, 12, 0), initial_dictionary(patches, 12, 1)
    sums = measured(patches, good, 3)
    other_sums = replace(measured(patches, other, 3), error=sums.error * (1 + rise))
    best, accepted = judge(Best(good, sums), other, other_sums)
    assert accepted == (rise == 0) and best.step == (1 if goes_on else 0.5)
    trial, _ = next_trial(best, other, None, other_sums)
    start = (other, other_sums, 1.0) if goes_on else (good, sums, 0.5)
    assert (trial == updated_dictionary(*start)[0]).all()


def test_learning__replacements_of_unused_atoms_are_taken_back_with_a_trial_that_did_much_worse():
    rng = np.random.default_rng(3)
    patches, _ = planted(rng, 600, 12, 48)
    dictionary = initial_dictionary(patches, 12, 0)
    sums = measured(patches, dictionary, 1)
    sums.n_users[5], sums.gain[5], sums.moment[5] = 0, 0, 0
    best = Best(dictionary, sums, 0.5)
    assert next_trial(best, dictionary, None, sums)[1] >= 1
    trial, n_replaced = next_trial(best, dictionary, None, replace(sums, error=2 * sums.error))
    assert n_replaced == 0 and (trial[5] == dictionary[5]).all()


def test_learning__atoms_go_on_as_they_came_but_not_where_they_were_replaced_or_the_error_rose():
    rng = np.random.default_rng(5)
    patches, true = planted(rng, 600, 12, 48)
    before = normalised(true + 0.10 * rng.standard_normal(true.shape) / np.sqrt(48))
    dictionary = normalised(true + 0.05 * rng.standard_normal(true.shape) / np.sqrt(48))
    before[3] = -dictionary[3]  # another atom was here
    sums = measured(patches, dictionary, 3)
    plain, _ = updated_dictionary(dictionary, sums)
    further, _ = next_trial(Best(dictionary, sums), dictionary, before, sums)
    expected = normalised(plain + MOMENTUM * (dictionary - before))
    expected[3] = plain[3]
    np.testing.assert_allclose(further, expected, atol=1e-6)
    assert np.abs(further - plain)[[0, 1, 2]].max() > 1e-3
    better = Best(before, replace(sums, error=0.99 * sums.error))
    assert (next_trial(better, dictionary, before, sums)[0] == plain).all()


@pytest.fixture
def staged(tmp_path, monkeypatch):
    """The stages of learning on patches of this file, without the stages before them."""
    patches = np.random.default_rng(4).permutation(always_together(2, noise=0.05))  # as a training set lies

    def part(folder, index: int, share: float = 1.0) -> TrainingPart:
        n = math.ceil(750 * share)
        return TrainingPart(patches[750 * index :][:n], np.zeros(n))

    monkeypatch.setattr(training, "training_part", part)
    monkeypatch.setattr(stages, "first_coefficients", lambda folder, index, n: part(folder, index).coefficients[:n])
    monkeypatch.setattr(
        stages.work,
        "summary",
        lambda folder, kind, read=stages.work.summary: InParts(2) if folder.name == "training" else read(folder, kind),
    )
    return tmp_path, patches


def test_learning__the_stages_keep_the_best_dictionary_too(staged):
    folder, patches = staged
    space = folder / "training"
    learned = run_stage(DictionarySeed(space, 8, 0), folder, SerialExecutor(), Heard()).folder
    records = []
    for iteration in range(13):
        record = run_stage(KsvdUpdate(space, learned, 2, 0.0, iteration), folder, SerialExecutor(), Heard())
        records.append(record.summary)
        learned = record.folder
    curve = np.array([r.squared_error for r in records])
    tried = np.array([r.measured_error for r in records])
    assert rises(curve).max() <= MONOTONE and (curve == np.minimum.accumulate(tried)).all()
    assert any(not r.accepted for r in records)
    assert measured(patches, arrays.read(learned, "best"), 2).error == pytest.approx(curve[-1], rel=1e-6)


def test_learning__passes_over_few_patches_are_of_each_part_and_judged_by_themselves(staged):
    folder, patches = staged
    learned = run_stage(DictionarySeed(folder / "training", 8, 0), folder, SerialExecutor(), Heard()).folder
    few, of_best = np.concatenate([patches[:188], patches[750 : 750 + 188]]), []
    for iteration, share in enumerate([0.25, 0.25, 0.25, 1.0, 1.0, 1.0]):
        stage = KsvdUpdate(folder / "training", learned, 2, 0.0, iteration, share=share, quantised_share=0.25)
        record = run_stage(stage, folder, SerialExecutor(), Heard())
        looked_at, found = (few, 1) if share < 1 else (patches, 2), record.summary
        assert (found.n_patches, record.n_tasks) == (len(looked_at[0]), looked_at[1])
        learned = record.folder
        best = arrays.read(learned, "best")
        assert found.squared_error == pytest.approx(measured(looked_at[0], best, 2).error, rel=1e-6)
        of_best.append((found.quantised_error, measured(few, best, 2).error, found.accepted))
    told, here, accepted = map(np.array, zip(*of_best))
    assert told == pytest.approx(here, rel=1e-6) and accepted[3]  # errors of few are never compared with those of all


def test_learning__passes_as_coded_are_judged_by_what_coding_costs_and_lower_it(staged):
    """With beams, weights at levels and a multiplier: error alone may rise where atoms are saved."""
    folder, patches = staged
    space, multiplier = folder / "training", 0.05
    learned = run_stage(DictionarySeed(space, 8, 0), folder, SerialExecutor(), Heard()).folder
    for iteration in range(2):
        learned = run_stage(KsvdUpdate(space, learned, 2, 0.0, iteration), folder, SerialExecutor(), Heard()).folder
    levels = np.tile(np.linspace(-2, 2, 8, dtype=np.float32), (2, 1))
    arrays.store(folder / "quantised", "weight_levels", levels)

    def cost(dictionary):
        found = pursue_patches(
            patches, dictionary, max_atoms=2, multiplier=multiplier, weight_levels=levels, pursuit="2x2"
        )
        return found.residual.sum() + multiplier * found.codes.n_atoms.sum()

    costs, before = [], arrays.read(learned, "dictionary")
    for iteration in range(2, 8):
        stage = KsvdUpdate(space, learned, 2, 0.0, iteration, multiplier, quantised=folder / "quantised", pursuit="2x2")
        record = run_stage(stage, folder, SerialExecutor(), Heard())
        learned = record.folder
        costs.append(record.summary.squared_error)
        assert record.summary.as_coded
    assert costs[0] <= cost(before) * (1 + 1e-6) and (np.diff(costs) <= 0).all()
    assert costs[-1] == pytest.approx(cost(arrays.read(learned, "best")), rel=1e-6) and costs[-1] < 0.9 * costs[0]


# --- atoms that are not used, or not told apart
# -------------------------------------------------------------------------


def test_learning__unused_atoms_and_twins_become_different_inputs():
    rng = np.random.default_rng(4)
    patches, _ = planted(rng, 1500, 20, 64)
    dictionary = initial_dictionary(patches, 20, 0)
    dictionary[3], dictionary[9] = dictionary[4], -dictionary[4]
    sums = measured(patches, dictionary, 3)
    updated, n_replaced = updated_dictionary(dictionary, sums)
    assert n_replaced >= 2
    assert_sound(updated)
    inputs = patches / np.linalg.norm(patches, axis=1, keepdims=True)
    replaced = [k for k in (3, 4, 9) if np.abs(inputs @ updated[k]).max() > 1 - 1e-5]
    assert len(replaced) >= 2


def test_learning__twins_are_found_wherever_they_stand_in_a_large_dictionary():
    rng = np.random.default_rng(5)
    atoms = rng.standard_normal((2100, 24)).astype(np.float32)
    pairs = {5: 7, 3: 1024, 1023: 1025, 1026: 2048, 2050: 2099, 0: 2047, 1500: 1501}
    for earlier, later in pairs.items():
        atoms[later] = -atoms[earlier]
    atoms /= np.linalg.norm(atoms, axis=1, keepdims=True)
    n = len(atoms)
    sums = Sums(
        np.zeros((n, 24)),
        np.ones(n),
        np.full(n, 9),
        0.0,
        9 * n,
        np.zeros(len(pairs)),
        rng.standard_normal((len(pairs), 24)).astype(np.float32),
    )
    updated, n_replaced = updated_dictionary(atoms, sums)
    assert n_replaced == len(pairs)
    assert np.flatnonzero(np.abs(updated - atoms).max(axis=1) > 1e-3).tolist() == sorted(pairs.values())


def test_learning__without_replacement_a_dead_atom_stays_dead():
    """The naive update: an atom without users divides by zero, or stays what it was."""
    rng = np.random.default_rng(5)
    patches, atoms = planted(rng, 1500, 10, 64)
    dictionary = np.concatenate([atoms, atoms[:3]]).astype(np.float32)
    weights = dense(pursue_patches(patches, dictionary, max_atoms=3).codes, 13)
    naive = reference.ksvd_power_iteration(patches, dictionary, weights)
    assert (np.abs(naive @ naive.T)[~np.eye(13, dtype=bool)] > MOST_COHERENCE).any()
    updated, _ = updated_dictionary(dictionary, measured(patches, dictionary, 3))
    assert_sound(updated)


@pytest.mark.parametrize("users", [0, 1, 3, 4])
def test_learning__an_atom_needs_four_users(users):
    rng = np.random.default_rng(6)
    patches, _ = planted(rng, 1000, 20, 64)
    dictionary = initial_dictionary(patches, 20, 0)
    sums = measured(patches, dictionary, 3)
    sums.n_users[:] = 100
    sums.n_users[7] = users
    assert updated_dictionary(dictionary, sums)[1] == (users < 4)


def poor_inputs() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(7)
    row = rng.standard_normal(48).astype(np.float32)
    return {
        "all equal": np.tile(row, (100, 1)),
        "all equal but for sign": np.outer(np.tile([1, -1], 50), row).astype(np.float32),
        "equal but for rounding": (row + 1e-7 * rng.standard_normal((100, 48))).astype(np.float32),
        "fewer than atoms": rng.standard_normal((5, 48)).astype(np.float32),
        "one": row[None],
        "rank one": np.outer(rng.standard_normal(100), row).astype(np.float32),
        "mostly zero": np.concatenate([np.zeros((99, 48)), row[None]]).astype(np.float32),
        "tiny": (1e-15 * rng.standard_normal((100, 48))).astype(np.float32),
        "huge": (1e15 * rng.standard_normal((100, 48))).astype(np.float32),
    }


@pytest.mark.parametrize("name", poor_inputs())
def test_learning__poor_inputs_end_in_unit_atoms_without_twins(name):
    patches = poor_inputs()[name]
    learned, curve = curve_of(patches, 16, 8, 4)
    assert 1 <= len(learned) <= min(16, len(patches)) and np.isfinite(learned).all()
    assert_sound(learned)
    assert (np.diff(curve) <= MONOTONE * curve[:-1]).all()
    again, _ = curve_of(patches, 16, 8, 4)
    assert (learned == again).all()


def test_learning__residuals_of_rank_one_are_learned_in_one_update():
    rng = np.random.default_rng(8)
    patches = np.outer(rng.uniform(1, 2, 200), unit_rows(rng, 1, 48)[0]).astype(np.float32)
    start = patches[:1] + 0.3 * rng.standard_normal((1, 48)).astype(np.float32)
    start /= np.linalg.norm(start)
    updated, _ = updated_dictionary(start, measured(patches, start, 1))
    assert np.abs(updated[0] @ patches[0]) / np.linalg.norm(patches[0]) > 1 - 1e-6


def test_learning__an_atom_orthogonal_to_all_inputs_does_not_stay_there():
    """A power iteration that starts at right angles to the answer never moves; here it has no users and is replaced."""
    rng = np.random.default_rng(9)
    patches = rng.standard_normal((300, 48)).astype(np.float32)
    patches[:, 0] = 0
    start = np.zeros((2, 48), np.float32)
    start[0, 0] = start[1, 1] = 1
    residual = patches.astype(float)
    naive = reference.dead_atom_normalised(
        residual, residual @ start[0]
    )  # the naive power iteration: no direction at all
    assert np.isnan(naive).all()
    updated, n_replaced = updated_dictionary(start, measured(patches, start, 1))
    assert n_replaced == 1 and updated[0, 0] == 0
    assert_sound(updated)


def test_learning__equal_leading_singular_values_give_the_same_atom_every_time():
    rng = np.random.default_rng(10)
    basis = np.linalg.qr(rng.standard_normal((48, 2)))[0].T
    angle = np.arange(360) * np.pi / 180
    patches = (np.column_stack([np.cos(angle), np.sin(angle)]) @ basis).astype(np.float32)
    atoms = [learn_dictionary(patches, 1, max_atoms=1, iterations=6, seed=3) for _ in range(2)]
    assert (atoms[0] == atoms[1]).all() and np.linalg.norm(basis @ atoms[0][0]) == pytest.approx(1, abs=1e-5)
    assert_sound(learn_dictionary(patches, 4, max_atoms=1, iterations=6))


def test_learning__the_worst_patches_are_kept_in_order_and_their_ties_by_place():
    rng = np.random.default_rng(11)
    patches = rng.standard_normal((40, 48)).astype(np.float32)
    patches[10] = patches[20] = patches[30]
    sums = measured(patches, unit_rows(rng, 4, 48), 1)
    assert (np.diff(sums.worst_error) <= 0).all() and len(sums.worst_error) == 40
    np.testing.assert_allclose(np.linalg.norm(sums.worst_patch, axis=1), 1, atol=1e-6)
    assert ksvd.WORST >= 40
