"""A dictionary in a stage's folder, with what its search needs: made once, read once by every process that searches.

Arrays: dictionary (k, d) float32 unit rows; where atoms are turned too, turned (8 k, d), and the others are of those;
beyond 16,384 atoms, where there is no k x k array anywhere, basis (d, p), short (k, p) and rest (k,) of short products,
all float32. Gram matrices are made where they are needed, which takes no longer than reading them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.coding.grid import AtomForm
from pipeline.coding.omp import Pursuit, pursue_patches
from pipeline.coding.search.choice import MOST_WITH_GRAM, ready_for
from pipeline.coding.search.protocol import SearchedDictionary
from pipeline.coding.search.stepwise import StepwiseDictionary, shorten, unshortened
from pipeline.coding.search.symmetric import with_symmetries
from storage.work import arrays

KEPT_BYTES = (
    1280 << 20
)  # of a dictionary with its Gram matrix, what a process may keep for its next task: 16,384 atoms of whole patches

_kept: dict[Path, Atoms] = {}  # the dictionary that this process read last; a complete stage's folder never changes


@dataclass(frozen=True)
class Atoms:
    """A dictionary as its stage left it."""

    searched: SearchedDictionary

    @property
    def dictionary(self) -> np.ndarray:
        """(k, d) float32, in all the symmetries there are."""
        return self.searched.dictionary

    @property
    def n_bytes(self) -> int:
        return self.searched.n_bytes

    def pursue(
        self,
        patches: np.ndarray,
        max_atoms: int,
        tolerance: float | np.ndarray,
        levels: np.ndarray | None = None,
        multiplier: float = 0.0,
        search: str = "certified",
        pursuit: str = "omp",
    ) -> Pursuit:
        """The pursuit of patches (n, d) on one thread, with the atoms that exact search takes; an approximate `search`
        takes those that short products tell, of a dictionary that was split when it was stored: of others it is
        exact."""
        return pursue_patches(
            patches,
            self.searched,
            max_atoms=min(max_atoms, len(self.dictionary)),
            tolerance=tolerance,
            multiplier=multiplier,
            weight_levels=levels,
            search=search,
            pursuit=pursuit,
        )


def store_atoms(folder: Path, dictionary: np.ndarray, form: AtomForm = AtomForm()) -> None:
    """Write a dictionary (k, d) into a stage's folder, with what the search of its form takes besides."""
    stored = {"dictionary": dictionary}
    if form.n_turns > 1:
        stored["turned"] = dictionary = form.in_turns(dictionary)
    # Products with all turns of an atom take no longer than short ones.
    if form.n_turns == 1 and len(dictionary) > MOST_WITH_GRAM and (split := shorten(dictionary)):
        stored |= {"basis": split.basis, "short": split.short, "rest": split.rest}
    for name, rows in stored.items():
        arrays.store(folder, name, rows.astype(np.float32, copy=False), (4096, *rows.shape[1:]))


def load_atoms(folder: Path) -> Atoms:
    """The dictionary of a folder. A process keeps the last one, where it is small enough: a stage's tasks all read the
    same, and with 4,096 atoms of 192 coefficients that took as long as coding 2,000 patches."""
    atoms = _kept.get(folder)
    if atoms is None:
        _kept.clear()
        atoms = _read_atoms(folder)
        if atoms.n_bytes <= KEPT_BYTES:
            _kept[folder] = atoms
    return atoms


def _read_atoms(folder: Path) -> Atoms:
    dictionary = arrays.read(folder, "dictionary")
    if arrays.exists(folder, "turned"):
        turned, size = arrays.read(folder, "turned"), round((dictionary.shape[1] / 3) ** 0.5)
        with_gram = len(turned) <= MOST_WITH_GRAM
        found = with_symmetries(dictionary, size, turned, with_gram)
        return Atoms(found if with_gram else unshortened(turned, found))
    if arrays.exists(folder, "basis"):
        basis, short, rest = (arrays.read(folder, name) for name in ("basis", "short", "rest"))
        return Atoms(StepwiseDictionary(dictionary, basis, short, rest))
    return Atoms(unshortened(dictionary) if len(dictionary) > MOST_WITH_GRAM else ready_for("certified", dictionary))
