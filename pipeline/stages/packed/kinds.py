"""Codes and extras -> the batches of the packed file: which kinds of splats there are."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.stages.points.kept import MOST_PARTS, PART
from storage.packed.schema import EXTRAS, Batch
from storage.work import arrays

KIND_DIGITS = 2 ** np.arange(
    len(EXTRAS), -1, -1
)  # of `Batch.kind` as one number: a bit for each extra, above them the atoms


@dataclass(frozen=True)
class KindsFound:
    """What a task tells of its splats: their kinds, by KIND_DIGITS, ascending."""

    n_splats: int
    kinds: list[int]


@dataclass(frozen=True)
class BatchesFound:
    """Of all splats."""

    batches: tuple[Batch, ...]


@dataclass(frozen=True)
class Kinds:
    """A task some blocks of splats. A scan of few is looked through by the process that asks (`batches_of`)."""

    n_splats: int
    codes: Path | None
    extras: tuple[tuple[str, Path], ...] = ()  # as of `Pack`
    name = "kinds"

    def init(self, folder: Path) -> int:
        return arrays.n_blocks(self.n_splats, self._rows)

    def run(self, folder: Path, index: int) -> KindsFound:
        start, stop = arrays.block_range(index, self.n_splats, self._rows)
        return KindsFound(stop - start, sorted(_kinds_in(start, stop, self.codes, self.extras)))

    def finalise(self, folder: Path, results: list[KindsFound]) -> BatchesFound:
        return BatchesFound(_batches({kind for r in results for kind in r.kinds}))

    @property
    def _rows(self) -> int:
        wanted = max(PART, -(-self.n_splats // MOST_PARTS))
        return -(-wanted // arrays.BLOCK) * arrays.BLOCK


def kinds_of(n_atoms: np.ndarray, extras: tuple[tuple[str, Path], ...], start: int, stop: int) -> np.ndarray:
    """What tells the batch of each splat start..stop, `Batch.kind` as one number by KIND_DIGITS: (n,) int64."""
    flags = dict(extras)
    columns = [
        arrays.read(flags[e.flag], f"has_{e.flag}", start, stop) if e.flag in flags else np.zeros(stop - start, bool)
        for e in EXTRAS
    ]
    if {"clipline", "ellipsoid"} <= flags.keys():
        clipline, ellipsoid = ([e.flag for e in EXTRAS].index(flag) for flag in ("clipline", "ellipsoid"))
        columns[clipline] = columns[clipline] & ~columns[ellipsoid]  # the disc that would have been cut is not drawn
    digits = zip(KIND_DIGITS, [n_atoms, *columns], strict=True)
    return np.sum([digit * column.astype(np.int64) for digit, column in digits], axis=0)


def batches_of(n_splats: int, codes: Path | None, extras: tuple[tuple[str, Path], ...]) -> tuple[Batch, ...]:
    """The batches that a scan's splats make, by what they have beside atoms, then by their atoms."""
    return _batches(_kinds_in(0, n_splats, codes, extras))


def _kinds_in(first: int, end: int, codes: Path | None, extras: tuple[tuple[str, Path], ...]) -> set[int]:
    found: set[int] = set()
    for start in range(first, end, arrays.BLOCK):
        stop = min(start + arrays.BLOCK, end)
        n_atoms = np.zeros(stop - start, np.uint8) if codes is None else arrays.read(codes, "n_atoms", start, stop)
        found.update(np.flatnonzero(np.bincount(kinds_of(n_atoms, extras, start, stop))).tolist())
    return found


def _batches(kinds: set[int]) -> tuple[Batch, ...]:
    found = {(*(kind // KIND_DIGITS[1:] % 2).tolist(), kind // int(KIND_DIGITS[0])) for kind in kinds}
    return tuple(
        Batch(n, **{e.flag: bool(has) for e, has in zip(EXTRAS, flags, strict=True)}) for *flags, n in sorted(found)
    )
