"""Where the code of a splat lies: batches, groups and the word stream.

Splats stand in chunk order; inside a chunk they are sorted by batch. The codes of a group stand batch by batch, inside
a batch in splat order, and every group begins on a whole word. So one table, the count of each batch in each chunk,
tells the batch and the row of every splat.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from storage.packed.schema import CHUNK, EXTRAS, GROUP, Batch

CHUNKS_PER_GROUP = GROUP // CHUNK


@dataclass(frozen=True)
class Rows:
    """Batch and place of each splat of a run of whole groups."""

    batch: np.ndarray  # (n,) uint8
    entry: np.ndarray  # (n,) int64: its first atom, counted from its group's first
    extra: dict[str, np.ndarray]  # by flag of EXTRAS, (n,) int64: its place among its group's; -1 where it has none

    @property
    def clipline(self) -> np.ndarray:
        return self.extra["clipline"]


def count_batches(batch: np.ndarray, n_batches: int) -> np.ndarray:
    """The table of counts (n_chunks, n_batches) uint8 of the batches (n,) of consecutive splats."""
    chunk = np.arange(len(batch)) // CHUNK
    n_chunks = -(-len(batch) // CHUNK)
    flat = np.bincount(chunk * n_batches + batch, minlength=n_chunks * n_batches)
    return flat.reshape(n_chunks, n_batches).astype(np.uint8)


def rows_of(batch_count: np.ndarray, batches: tuple[Batch, ...]) -> Rows:
    """The rows of all splats that `batch_count` (n_chunks, n_batches) counts; its first chunk begins a group."""
    n_batches = len(batches)
    counts = batch_count.astype(np.int64)
    splat_batch = np.repeat(np.tile(np.arange(n_batches), len(counts)), counts.ravel())
    group = np.arange(len(splat_batch)) // GROUP
    key = group * n_batches + splat_batch
    order = np.argsort(key, kind="stable")  # group by group, batch by batch, in splat order
    has = {extra.flag: np.array([getattr(batch, extra.flag) for batch in batches])[splat_batch] for extra in EXTRAS}
    return Rows(
        batch=splat_batch.astype(np.uint8),
        entry=_running(np.array([batch.n_atoms for batch in batches])[splat_batch], group, order),
        extra={flag: np.where(some, _running(some.astype(np.int64), group, order), -1) for flag, some in has.items()},
    )


def _running(amount: np.ndarray, group: np.ndarray, order: np.ndarray) -> np.ndarray:
    """For each splat the sum of `amount` over those before it in its group, in the given order."""
    before = np.cumsum(amount[order]) - amount[order]
    starts = np.searchsorted(group[order], group[order])
    result = np.empty(len(order), np.int64)
    result[order] = before - before[starts]
    return result


def group_batch_counts(batch_count: np.ndarray) -> np.ndarray:
    """How many splats of each batch each group has, (n_groups, n_batches) int64."""
    starts = np.arange(0, len(batch_count), CHUNKS_PER_GROUP)
    return np.add.reduceat(batch_count.astype(np.int64), starts, axis=0)
