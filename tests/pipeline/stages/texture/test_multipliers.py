"""One multiplier for all splats: what it does to a pursuit, and how it is found."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.coding.omp import pursue_patches
from pipeline.coding.quantise import uniform_weight_levels
from pipeline.stages.texture.atoms import load_atoms, store_atoms
from pipeline.stages.texture.contrast_octaves import N_OCTAVES, octave_of
from pipeline.stages.texture.multipliers import Multipliers, multiplier_for
from pipeline.summaries import InParts, Ladder, Training
from storage.work import arrays, work


def patches_and_atoms(n_atoms: int, dim: int = 96) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    atoms = rng.standard_normal((n_atoms, dim)).astype(np.float32)
    patches = rng.standard_normal((60, dim)) * rng.uniform(0.1, 2, (60, 1))
    return patches.astype(np.float32), atoms / np.linalg.norm(atoms, axis=1, keepdims=True)


@pytest.mark.parametrize("search", ["exact", "certified"])
@pytest.mark.parametrize("n_atoms", [40, 1200])
@pytest.mark.parametrize("multiplier", [0.3, 2.0])
def test_multiplier__every_atom_taken_is_worth_it_and_the_next_is_not(search, n_atoms, multiplier):
    patches, atoms = patches_and_atoms(n_atoms)
    steps = np.stack(
        [(patches.astype(np.float64) ** 2).sum(axis=1)]
        + [pursue_patches(patches, atoms, max_atoms=most, search=search).residual for most in range(1, 7)],
        axis=1,
    )
    worth = -np.diff(steps, axis=1) > multiplier
    expected = np.where(worth.all(axis=1), 6, worth.argmin(axis=1))
    found = pursue_patches(patches, atoms, max_atoms=6, multiplier=multiplier, search=search)
    assert 0 < expected.mean() < 6
    assert (found.codes.n_atoms == expected).all()
    np.testing.assert_allclose(found.residual, steps[np.arange(60), expected], rtol=1e-5)


@pytest.mark.parametrize("n_atoms", [40, 1200])
def test_multiplier__a_pursuit_at_the_lowest_tells_what_others_take(n_atoms):
    patches, atoms = patches_and_atoms(n_atoms)
    levels = np.tile(np.linspace(-2, 2, 16), (6, 1))
    lowest = pursue_patches(patches, atoms, max_atoms=6, multiplier=0.1, weight_levels=levels)
    for multiplier in (0.1, 0.3, 2.0, 1e9):
        found, taken = (
            pursue_patches(patches, atoms, max_atoms=6, multiplier=multiplier, weight_levels=levels),
            lowest.atoms_at(multiplier),
        )
        assert (taken == found.codes.n_atoms).all()
        np.testing.assert_allclose(lowest.path[np.arange(60), taken], found.residual, rtol=1e-6)


def test_multiplier__spends_the_same_atoms_better_than_a_cut_off():
    patches, atoms = patches_and_atoms(200)
    valued = pursue_patches(patches, atoms, max_atoms=8, multiplier=0.5)
    cut = min(
        (pursue_patches(patches, atoms, max_atoms=8, tolerance=t) for t in np.geomspace(0.01, 300, 80)),
        key=lambda found: (found.codes.n_atoms.sum() > valued.codes.n_atoms.sum(), found.residual.sum()),
    )
    assert valued.residual.sum() < cut.residual.sum()


LADDER = Ladder(multiplier=(2.0, 1.0, 0.5), error=(8.0, 4.0, 2.0), n_atoms=(1.0, 2.0, 3.0))
WHOLE = Training(1, 10, n_splats=10, n_active=10, cutoff_error=0.0, settled_energy=0.0, beyond={})


def multiplier_at(ladder: Ladder, training: Training, patch_error: float) -> float:
    return multiplier_for(ladder, replace(training, cutoff_error=patch_error * training.n_splats))


def test_multiplier__is_found_between_those_of_the_ladder():
    assert multiplier_at(LADDER, WHOLE, 4.0) == pytest.approx(1.0)
    assert multiplier_at(LADDER, WHOLE, np.sqrt(32)) == pytest.approx(np.sqrt(2))


def test_multiplier__settled_splats_leave_more_to_the_others():
    half = replace(WHOLE, n_active=5, settled_energy=5.0)
    assert multiplier_at(LADDER, half, 2.5) == pytest.approx(1.0)


@pytest.mark.parametrize(("wanted", "found"), [(0.1, 0.5), (100.0, 2.0)])
def test_multiplier__beyond_the_ladder_is_its_end(wanted, found):
    assert multiplier_at(LADDER, WHOLE, wanted) == pytest.approx(found)


@pytest.mark.parametrize(
    ("last", "lowest", "highest"), [(4.0, 0.8, 1.5), (3.74, 0.7, 0.72), (3.7, 0.5, 0.5), (2.0, 0.5, 0.5)]
)
def test_multiplier__ends_where_splats_have_run_out_of_atoms(last, lowest, highest):
    """An atom more from the second multiplier to the third: 0.3 dB are 4.0 to 3.733."""
    ladder = replace(LADDER, error=(8.0, 4.0, last))
    assert lowest * 0.999 <= multiplier_at(ladder, WHOLE, 0.1) <= highest * 1.001


def test_multiplier__ends_at_one_price_whatever_the_target_that_is_missed():
    """Ladders of other targets have other multipliers; what an atom gains at a multiplier is the scan's own."""

    def ladder(first: float) -> Ladder:
        multiplier = first * 2.0 ** -np.arange(8)
        return Ladder(*(tuple(x.tolist()) for x in (multiplier, 1 + multiplier, 6 - np.log(multiplier) / 2)))

    ends = [multiplier_at(ladder(first), WHOLE, 1e-6) for first in (1.0, 1.3, 1.7, 2.5)]
    assert max(ends) < 1.05 * min(ends) and min(ends) > 0.02


def test_multiplier__is_no_cliff_at_its_end():
    """As the target goes on beyond what atoms can show, the multiplier stays where it is."""
    ladder = Ladder((2.0, 1.0, 0.5, 0.25), (8.0, 4.0, 3.5, 3.4), (1.0, 2.0, 3.0, 5.0))
    multipliers = [multiplier_at(ladder, WHOLE, wanted) for wanted in np.geomspace(8, 0.01, 60)]
    assert all(b <= a for a, b in zip(multipliers, multipliers[1:])) and 0.4 < multipliers[-1] < 1
    assert max(a / b for a, b in zip(multipliers, multipliers[1:])) < 2


def test_weights__even_levels_are_the_same_for_every_rank_and_as_wide_as_pays():
    rng = np.random.default_rng(0)
    ranks = [rng.normal(0, scale, 4000) for scale in (2, 1, 0.5)]
    levels = uniform_weight_levels(ranks, 16)
    assert (levels == levels[0]).all()
    np.testing.assert_allclose(np.diff(levels[0]), levels[0, -1] / 7.5, rtol=1e-5)
    sample = np.concatenate(ranks)

    def error(row):
        return np.abs(sample[:, None] - row).min(axis=1) @ np.abs(sample[:, None] - row).min(axis=1)

    assert error(levels[0]) <= min(error(levels[0] * factor) for factor in (0.8, 1.25))


def ladder_of(folder, patches: np.ndarray, share: np.ndarray, n_tasks: int = 1, pursuit: str = "omp") -> Ladder:
    """What patches that nothing is learned from, of a training set that is such a share of each octave, find with 16
    atoms."""
    space, chosen, quantised = (folder / name for name in ("space", "chosen", "quantised"))
    work.begin(space)
    work.begin(chosen)
    for i, rows in enumerate(np.array_split(np.arange(len(patches)), n_tasks)):
        arrays.store(space, f"held_coefficient_{i}", patches[rows])
        arrays.store(space, f"held_rest_{i}", np.zeros(len(rows), np.float32))
    work.complete(space, InParts(n_tasks), 0.0)
    work.write_json(chosen / "share.json", {"share": share.tolist()})
    work.complete(chosen, replace(WHOLE, n_patches=len(patches)), 0.0)
    work.begin(quantised)
    atoms = np.random.default_rng(9).standard_normal((16, patches.shape[1]))
    store_atoms(quantised, atoms / np.linalg.norm(atoms, axis=1, keepdims=True))
    arrays.store(quantised, "weight_levels", np.tile(np.linspace(-4, 4, 16, dtype=np.float32), (8, 1)))
    stage = Multipliers(space, chosen, quantised, 8, 1.0, pursuit)
    return stage.finalise(folder, [stage.run(folder, i) for i in range(n_tasks)])


def test_multipliers__are_those_of_the_same_splats_wherever_tasks_part_them(tmp_path):
    """A scan that is turned has the same training set, but for a few splats, in other tasks and places."""
    rng = np.random.default_rng(4)
    patches = (rng.standard_normal((9000, 12)) * rng.uniform(0.2, 4, (9000, 1))).astype(np.float32)
    share = np.full(N_OCTAVES, 0.3)
    turned = rng.permutation(9000)[:-3]
    still = ladder_of(tmp_path / "still", patches, share)
    moved = ladder_of(tmp_path / "turned", patches[turned], share, n_tasks=3)
    for figure in ("error", "n_atoms"):
        assert getattr(moved, figure) == pytest.approx(getattr(still, figure), rel=0.002)


@pytest.mark.parametrize("pursuit", ["omp", "ormp", "4x2"])
def test_multipliers__error_and_atoms_are_those_of_a_pursuit_at_each(tmp_path, pursuit):
    """A beam follows other supports at another multiplier."""
    patches = (2 * np.random.default_rng(6).standard_normal((300, 12))).astype(np.float32)
    ladder = ladder_of(tmp_path, patches, np.ones(N_OCTAVES), pursuit=pursuit)
    atoms, levels = load_atoms(tmp_path / "quantised"), arrays.read(tmp_path / "quantised", "weight_levels")
    for multiplier, error, n_atoms in zip(ladder.multiplier, ladder.error, ladder.n_atoms):
        found = atoms.pursue(patches, 8, 0.0, levels, multiplier, pursuit=pursuit)
        assert found.residual.mean() == pytest.approx(error, rel=1e-6)
        assert found.codes.n_atoms.mean() == pytest.approx(n_atoms, rel=1e-6)


def test_multipliers__what_is_rare_counts_as_rare_though_it_was_learned_from_whole(tmp_path):
    rng = np.random.default_rng(3)
    calm, busy = (
        rng.standard_normal((3600, 12)).astype(np.float32),
        8 * rng.standard_normal((60, 12)).astype(np.float32),
    )
    octaves = octave_of((busy.astype(np.float64) ** 2).sum(axis=1))
    calm = calm[octave_of((calm.astype(np.float64) ** 2).sum(axis=1)) < octaves.min()]
    share = np.where(np.arange(N_OCTAVES) < octaves.min(), 0.1, 1.0)
    whole = ladder_of(tmp_path / "whole", np.concatenate([calm, busy]), np.ones(N_OCTAVES))
    part = ladder_of(tmp_path / "part", np.concatenate([calm[::10], busy]), share)
    for figure in ("error", "n_atoms"):
        assert getattr(part, figure) == pytest.approx(getattr(whole, figure), rel=0.03)
