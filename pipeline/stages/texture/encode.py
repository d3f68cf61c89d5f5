"""Patches -> codes, with quantised weights in the loop; and what the coding lost."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.coding.grid import AtomForm, coefficients, patches_of
from pipeline.coding.omp import Codes, Pursuit, reconstruct
from pipeline.coding.omp_kernels import squared_norms
from pipeline.numerics.accuracy import psnr_db
from pipeline.stages.texture.atoms import load_atoms
from pipeline.stages.texture.colors import average_colors
from pipeline.stages.texture.resample import n_coarser_of
from pipeline.stages.texture.texels import texel_pieces
from pipeline.summaries import CodesMade
from pipeline.texture.patches import centred, patch_errors
from pipeline.texture.resample import PATCH_DIM, disc_weights
from storage.work import arrays

# Of an atom on a splat of a coarser level, which is drawn where it is some pixels wide: on fountain_p11, draft, 36.8
# dB, its splats take 8.4 bytes each and those of the finest level 9.1; at the same multiplier 13 and more.
COARSER_PRICE = 4.0
ROWS = 1024  # patches in float32 at a time: 12 MiB


@dataclass(frozen=True)
class BlockCoded:
    """What a task tells of its block: squared errors, those weighted by what is visible, and splats by their atoms."""

    n_splats: int
    n_measured: int  # of the finest level
    squared_error: float
    weighted_error: float
    histogram: list[int]


@dataclass(frozen=True)
class Encode:
    """A task a block. Arrays: n_atoms (n,) uint8, atom (n, r) uint16, weight_code (n, r) uint8, error (n,) float32: the
    squared norm that is left of each patch, before its texels are clamped. Atoms of coarser levels have COARSER_PRICE;
    what is said of errors is of the finest."""

    patches: Path
    colors: Path
    quantised: Path | None  # None where nothing calls for a dictionary: every splat has 0 atoms
    max_atoms: int
    tolerance: float
    multiplier: float = 0.0
    form: AtomForm | None = None  # None: atoms are coded with as patches, else as coefficients
    search: str = "certified"  # of pipeline.coding.omp.SEARCHES
    pursuit: str = "omp"  # a word of pipeline.coding.beam.form
    name = "encode"

    def init(self, folder: Path) -> int:
        n = arrays.layout_of(self.patches, "energy").shape[0]
        arrays.create(folder, "n_atoms", (n,), "uint8")
        arrays.create(folder, "atom", (n, self._n_ranks), "uint16")
        arrays.create(folder, "weight_code", (n, self._n_ranks), "uint8")
        arrays.create(folder, "error", (n,), "float32")
        return arrays.n_blocks(n)

    def run(self, folder: Path, index: int) -> BlockCoded:
        start, stop = arrays.block_range(index, arrays.layout_of(self.patches, "energy").shape[0])
        encode = self._encoder()
        average = average_colors(self.colors, start, stop)
        n_atoms = np.zeros(stop - start, np.uint8)
        atom = np.zeros((stop - start, self._n_ranks), np.uint16)
        weight_code, error = np.zeros((stop - start, self._n_ranks), np.uint8), np.zeros(stop - start, np.float32)
        squared, weighted, n_coarser = (
            0.0,
            0.0,
            n_coarser_of(self.patches),
        )  # whole groups: no ROWS have some of two levels
        for at, texel in texel_pieces(self.patches, start, stop, ROWS):
            rows = slice(at - start, at - start + len(texel))
            found, decoded = encode(centred(texel, average[rows]), COARSER_PRICE if at < n_coarser else 1.0)
            used = found.weight_code.shape[1]
            n_atoms[rows], atom[rows, :used] = found.codes.n_atoms, found.codes.atom_index
            weight_code[rows, :used], error[rows] = found.weight_code, found.residual
            if at < n_coarser:
                continue
            lost = patch_errors(texel, average[rows], decoded, found.codes.n_atoms > 0)
            squared, weighted = squared + lost[0], weighted + lost[1]
        for name, values in (("n_atoms", n_atoms), ("atom", atom), ("weight_code", weight_code), ("error", error)):
            arrays.write(folder, name, start, values)
        return BlockCoded(
            n_splats=stop - start,
            n_measured=max(0, stop - max(start, n_coarser)),
            squared_error=squared,
            weighted_error=weighted,
            histogram=np.bincount(n_atoms, minlength=self._n_ranks + 1).tolist(),
        )

    def finalise(self, folder: Path, results: list[BlockCoded]) -> CodesMade:
        return coding_quality(results)

    @property
    def _n_ranks(self) -> int:
        return max(1, self.max_atoms)

    def _encoder(self):
        if self.quantised is None:
            return lambda patches, dearer: (_no_codes(patches), patches[:0])
        atoms, levels = load_atoms(self.quantised), arrays.read(self.quantised, "weight_levels")

        def encode(patches: np.ndarray, dearer: float) -> tuple[Pursuit, np.ndarray]:
            """Codes, and what atoms add to those patches that have some."""
            if self.form is None:
                found = atoms.pursue(
                    patches, self.max_atoms, dearer * self.tolerance, levels, search=self.search, pursuit=self.pursuit
                )
                return found, _of_atoms(found.codes, atoms.dictionary)
            size = self.form.size
            short = coefficients(patches, size)
            multiplier = dearer * self.multiplier
            found = atoms.pursue(short, self.max_atoms, self.tolerance, levels, multiplier, self.search, self.pursuit)
            beyond = np.maximum(squared_norms(patches) - squared_norms(short), 0)  # what atoms of this size cannot show
            return found.beside(beyond), patches_of(_of_atoms(found.codes, atoms.dictionary), size)

        return encode


def _of_atoms(codes: Codes, dictionary: np.ndarray) -> np.ndarray:
    """What the codes of patches with atoms stand for."""
    some = codes.n_atoms > 0
    return reconstruct(Codes(*(rows[some] for rows in codes)), dictionary)


def coding_quality(blocks: list[BlockCoded]) -> CodesMade:
    """Texture PSNR and visible PSNR of all blocks, and how many splats have how many atoms."""
    n, n_measured = sum(b.n_splats for b in blocks), sum(b.n_measured for b in blocks)
    squared, weighted = sum(b.squared_error for b in blocks), sum(b.weighted_error for b in blocks)
    histogram = np.sum([b.histogram for b in blocks], axis=0)
    return CodesMade(
        texture_psnr_db=psnr_db(squared, n_measured * PATCH_DIM),
        visible_psnr_db=psnr_db(weighted, n_measured * disc_weights().sum()),
        histogram=tuple(histogram.tolist()),
        mean_atoms=float(histogram @ np.arange(len(histogram)) / n),
    )


def _no_codes(patches: np.ndarray) -> Pursuit:
    n = len(patches)
    nothing = Codes(np.zeros((n, 0), np.int32), np.zeros((n, 0), np.float32), np.zeros(n, np.int32))
    return Pursuit(nothing, np.zeros((n, 0), np.int32), squared_norms(patches)[:, None])
