import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from storage.packed.batches import count_batches, group_batch_counts, rows_of
from storage.packed.schema import CHUNK, GROUP, Batch
from tests.packed_files import noise

BATCHES = (Batch(0), Batch(3), Batch(8), Batch(3, clipline=True), Batch(1, clipline=True))


def sorted_batches(n: int, seed: int = 0) -> np.ndarray:
    """Batches (n,) of splats that stand batch by batch in every chunk."""
    batch = noise(n, seed, len(BATCHES))
    return batch[np.lexsort((batch, np.arange(n) // CHUNK))]


def slow_places(batch: np.ndarray) -> tuple[list[int], list[int]]:
    """First atom and clipline row of each splat, by walking each group once for every batch."""
    entry, clipline = [0] * len(batch), [-1] * len(batch)
    for start in range(0, len(batch), GROUP):
        n_atoms = n_lines = 0
        for which, kind in enumerate(BATCHES):
            for splat in range(start, min(start + GROUP, len(batch))):
                if batch[splat] == which:
                    entry[splat] = n_atoms
                    n_atoms += kind.n_atoms
                    if kind.clipline:
                        clipline[splat] = n_lines
                        n_lines += 1
    return entry, clipline


@settings(deadline=None, derandomize=True, max_examples=30)
@given(st.integers(1, 700), st.integers(0, 1000))
def test_batches__counts_tell_the_batch_of_every_splat(n, seed):
    batch = sorted_batches(n, seed)
    assert (rows_of(count_batches(batch, len(BATCHES)), BATCHES).batch == batch).all()


@settings(deadline=None, derandomize=True, max_examples=15)
@given(st.integers(1, 700), st.integers(0, 1000))
def test_batches__places_are_those_of_a_walk_through_the_group(n, seed):
    batch = sorted_batches(n, seed)
    rows = rows_of(count_batches(batch, len(BATCHES)), BATCHES)
    entry, clipline = slow_places(batch)
    assert rows.entry.tolist() == entry
    assert rows.clipline.tolist() == clipline


def test_batches__every_group_starts_at_zero():
    batch = sorted_batches(2 * GROUP + 300)
    rows = rows_of(count_batches(batch, len(BATCHES)), BATCHES)
    entry, clipline = slow_places(batch)
    assert rows.entry.tolist() == entry
    assert rows.clipline.tolist() == clipline


def test_batches__a_group_alone_has_the_places_it_has_among_others():
    batch = sorted_batches(2 * GROUP + 300)
    counts = count_batches(batch, len(BATCHES))
    whole = rows_of(counts, BATCHES)
    part = rows_of(counts[GROUP // CHUNK : 2 * GROUP // CHUNK], BATCHES)
    assert (part.entry == whole.entry[GROUP : 2 * GROUP]).all()
    assert (part.clipline == whole.clipline[GROUP : 2 * GROUP]).all()


def test_batches__a_chunk_of_one_batch_fits_its_byte():
    assert count_batches(np.full(CHUNK, 2), 3).tolist() == [[0, 0, CHUNK]]


def test_batches__group_counts_add_up_the_chunks():
    batch = sorted_batches(2 * GROUP + 300)
    counts = group_batch_counts(count_batches(batch, len(BATCHES)))
    expected = [np.bincount(batch[s : s + GROUP], minlength=len(BATCHES)).tolist() for s in range(0, len(batch), GROUP)]
    assert counts.tolist() == expected


def test_batches__no_splats_have_no_rows():
    counts = count_batches(np.zeros(0, np.int64), 2)
    assert counts.shape == (0, 2)
    assert len(rows_of(counts, BATCHES[:2]).batch) == 0
    assert group_batch_counts(counts).shape == (0, 2)
