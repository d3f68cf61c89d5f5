"""A dictionary in a stage's folder, with what its search needs: made once, read once by every process that searches.

Arrays: dictionary (k, d) float32 unit rows; where atoms are turned too, turned (8 k, d), and the others are of those;
where it is searched by short products basis (d, p), short (k, p) and rest (k,), all float32. Gram matrices are made where
they are needed, which takes no longer than reading them. Beyond 16,384 atoms there is no k x k array anywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from pipeline.coding.certified import (
    FEWEST_ATOMS, MOST_WITH_GRAM, ShortDictionary, shorten, split_by, unshortened,
)
from pipeline.coding.coarse import CoarseDictionary, coarsen
from pipeline.coding.grid import AtomForm
from pipeline.coding.omp import Pursuit, pursue_patches
from storage import arrays

KEPT_BYTES = 256 << 20  # of a dictionary with its Gram matrix, what a process may keep for its next task

_kept: dict[Path, Atoms] = {}  # the dictionary that this process read last; a complete stage's folder never changes


@dataclass(frozen=True)
class Atoms:
    """A dictionary as its stage left it."""

    dictionary: np.ndarray  # (k, d) float32, in all the turns there are
    split: ShortDictionary | None
    gram: np.ndarray | None
    turned: bool = False

    @property
    def n_bytes(self) -> int:
        gram = self.gram if self.split is None else self.split.short_gram
        return self.dictionary.nbytes + (0 if gram is None else gram.nbytes)

    def pursue(self, patches: np.ndarray, max_atoms: int, tolerance: float | np.ndarray,
               levels: np.ndarray | None = None, price: float = 0.0, search: str = "certified") -> Pursuit:
        """The pursuit of patches (n, d) on one thread, with the atoms that exact search takes; an approximate `search` takes those
        that short products tell, of a dictionary that was split when it was stored: of others it is exact."""
        split, gram = self.split, self.gram
        if search == "exact":
            split, gram = None, self._whole_gram
        elif split is None and gram is not None and len(self.dictionary) >= FEWEST_ATOMS and not self.turned:
            # As exact, and for 4,096 atoms of 128 components in two thirds of the time: groups of atoms share bounds. Not so
            # for 512 atoms of 192 coefficients in 8 turns, of which a patch takes 2 to 5: 1.1 to 1.5 times the time.
            split, search = unshortened(self.dictionary, gram), "certified"
        elif split is None:
            split = self._coarse
        return pursue_patches(patches, self.dictionary if split is None else split, max_atoms=min(max_atoms, len(self.dictionary)),
                              tolerance=tolerance, price=price, weight_levels=levels, gram=gram,
                              search="exact" if split is None else search)

    @cached_property
    def _coarse(self) -> CoarseDictionary | None:
        return coarsen(self.dictionary, self.gram)

    @cached_property
    def _whole_gram(self) -> np.ndarray | None:
        if self.gram is None and len(self.dictionary) <= MOST_WITH_GRAM:
            return self.dictionary @ self.dictionary.T
        return self.gram


def store_atoms(folder: Path, dictionary: np.ndarray, form: AtomForm = AtomForm()) -> None:
    stored = {"dictionary": dictionary}
    if form.n_turns > 1:
        stored["turned"] = dictionary = form.in_turns(dictionary)
    split = shorten(dictionary)
    if split is not None:
        stored |= {"basis": split.basis, "short": split.short, "rest": split.rest}
    for name, rows in stored.items():
        arrays.store(folder, name, rows.astype(np.float32, copy=False), (4096, *rows.shape[1:]))


def load_atoms(folder: Path) -> Atoms:
    """The dictionary of a folder. A process keeps the last one, where it is small enough: a stage's tasks all read the same,
    and with 4,096 atoms of 192 coefficients that took as long as coding 2,000 patches."""
    atoms = _kept.get(folder)
    if atoms is None:
        _kept.clear()
        atoms = _read_atoms(folder)
        if atoms.n_bytes <= KEPT_BYTES:
            _kept[folder] = atoms
    return atoms


def _read_atoms(folder: Path) -> Atoms:
    turned = arrays.exists(folder, "turned")
    dictionary = arrays.read(folder, "turned" if turned else "dictionary")
    if arrays.exists(folder, "basis"):
        return Atoms(dictionary, split_by(dictionary, *(arrays.read(folder, n) for n in ("basis", "short", "rest"))), None, turned)
    return Atoms(dictionary, None, dictionary @ dictionary.T if len(dictionary) <= MOST_WITH_GRAM else None, turned)
