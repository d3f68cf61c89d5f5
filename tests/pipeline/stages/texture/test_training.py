"""The training set: what is chosen, and that only those rows are read."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.coding.grid import coefficients
from pipeline.execution.executors import SerialExecutor
from pipeline.execution.stage import run_stage
from pipeline.stages.texture.contrast_octaves import FEWEST, N_OCTAVES, census, octave_of, shares
from pipeline.stages.texture.training import Coefficients, TrainingSet, first_coefficients, held_part, training_part
from pipeline.summaries import AverageColors
from pipeline.texture.patches import centred
from storage.work import arrays, work
from tests.pipeline.execution.test_stage import Heard


def test_octaves__an_octave_is_a_factor_of_two():
    energy = np.float32(2.0) ** np.arange(-14, 12)
    octaves = octave_of(energy)
    assert (np.diff(octaves[2:]) == 1).all() and octaves.max() < N_OCTAVES and octave_of(np.zeros(1))[0] < N_OCTAVES
    assert (octave_of(energy[3:] * np.float32(1.99)) == octaves[3:]).all()
    assert census(energy).sum() == len(energy)


def test_octaves__make_the_number_wanted_and_leave_out_what_is_settled():
    counts = np.zeros(N_OCTAVES, int)
    counts[5:20] = 100_000
    share = shares(counts, 1.0, 30_000)
    below = octave_of(np.array([1.0]))[0]
    assert (share[:below] == 0).all() and counts @ share == pytest.approx(30_000, rel=1e-9)


def test_octaves__what_is_rare_is_learned_from_too():
    counts = np.zeros(N_OCTAVES, int)
    counts[14], counts[20], counts[21] = 1_000_000, 900, 100
    share = shares(counts, 1.0, 10_000)
    assert counts[20] * share[20] == pytest.approx(FEWEST) and share[21] == 1
    assert (share[counts == 0] == 0).all()


def test_octaves__a_small_scan_is_taken_whole_and_an_empty_one_not_at_all():
    counts = np.bincount([15], minlength=N_OCTAVES) * 300
    assert shares(counts, 1.0, 40_000)[15] == 1
    assert not shares(np.zeros(N_OCTAVES, int), 1.0, 40_000).any()


@pytest.mark.parametrize("rows", [[], [0], [9], [3, 4, 5, 9], list(range(10))])
def test_arrays__rows_alone_are_those_of_the_whole(tmp_path, rows):
    whole = np.arange(10 * 6, dtype=np.float32).reshape(10, 6)
    arrays.store(tmp_path, "rows", whole.astype(np.float32), (4, 6))
    found = arrays.read_rows(tmp_path, "rows", np.array(rows, int))
    assert found.dtype == whole.dtype and (found == whole[rows]).all()


def test_training__neither_the_choice_nor_its_order_turns_with_the_chunks(tmp_path):
    rng = np.random.default_rng(0)
    n = 3000
    rows = {
        "texel": rng.integers(0, 256, (n, 3072)).astype(np.uint8),
        "average": rng.integers(0, 256, (n, 3)).astype(np.float32),
        "energy": rng.uniform(0, 60, n).astype(np.float32),
        "point": np.arange(n),
    }

    def training_set(order: np.ndarray, seed: int = 0):
        patches = tmp_path / f"patches-{order[0]}"
        if not patches.exists():
            work.begin(patches)
            for name, values in rows.items():
                arrays.store(patches, name, values[order])
            work.complete(patches, AverageColors(n, None, tuple(census(rows["energy"]).tolist())), 0.0)
        return run_stage(TrainingSet(patches, patches, 8.0, 700, seed, 1.0), tmp_path, SerialExecutor(), Heard()).folder

    def chosen(order: np.ndarray, seed: int = 0) -> np.ndarray:
        return arrays.read(training_set(order, seed), "texel_0")

    still, turned = chosen(np.arange(n)), chosen(rng.permutation(n))
    assert 500 < len(still) < 1100 and (still == turned).all()
    assert len(still) != len(chosen(np.arange(n), seed=1)) or (still != chosen(np.arange(n), seed=1)).any()
    training = training_set(np.arange(n))
    space = run_stage(Coefficients(training, 8), tmp_path, SerialExecutor(), Heard())
    learned, held = (part(space.folder, 0).coefficients for part in (training_part, held_part))
    assert len(learned) == space.summary.n_patches and len(learned) + len(held) == len(still)
    assert 0.2 * len(still) < len(held) < 0.3 * len(still)  # a quarter, where HELD are more
    assert (arrays.read(training, "luck_0") >= 0.75).sum() == len(held)
    assert not set(map(bytes, learned)) & set(map(bytes, held))
    by_luck = np.argsort(arrays.read(training, "luck_0"))
    patches = centred(still[by_luck], arrays.read(training, "average_0")[by_luck])
    assert np.allclose(np.concatenate([learned, held]), coefficients(patches, 8), atol=1e-3)
    assert (training_part(space.folder, 0, 0.25).coefficients == learned[: -(-len(learned) // 4)]).all()
    first = first_coefficients(space.folder, 0, 9)
    assert (first == learned[:9]).all() and first.base is None, "and nothing of the others stays in memory"
