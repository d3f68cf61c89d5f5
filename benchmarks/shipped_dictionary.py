"""Makes the dictionary that ships with the program, of free photographs and procedural pictures, none of a scan.

    python -m benchmarks.shipped_dictionary [--atoms 512] [--patches 150000] [--passes 16] [--out FOLDER]

Eight photographs that scikit-image brings, CC0 or in the public domain (docs/DICTIONARY.md names their authors), are
three quarters of the patches, four pictures of dead leaves (Lee, Mumford, Huang 2001) the others. A patch is a square
of 6 to 64 pixels of a picture, evenly by octaves since a splat may show any scale, turned at random and seen at a slant.
Equal arguments make equal bytes on one machine; other BLAS libraries may round otherwise, so the file is kept.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import skimage.data

from benchmarks.patches import Silent
from pipeline.coding.grid import SYMMETRIES, AtomForm, coefficients, coefficients_of_texels, texels_of
from pipeline.execution.executors import SerialExecutor
from pipeline.numerics.accuracy import squared_error_at
from pipeline.stages.texture.atoms import load_atoms
from pipeline.stages.texture.dictionary import DictionarySeed, KsvdUpdate
from pipeline.stages.texture.training import training_part
from pipeline.summaries import CoefficientsFound
from pipeline.texture.patches import centred, measured
from pipeline.texture.resample import PATCH_DIM, Window, resample_patches
from services.flow.run import Run
from storage.packed.dictionaries.shipped import ATOM_SIZE, FOLDER, STEP, write_shipped
from storage.work import arrays, work

PHOTOGRAPHS = ("astronaut", "rocket", "chelsea", "coffee", "camera", "brick", "grass", "gravel")
GREY, PROCEDURAL = 0.15, 0.25  # shares of the patches: of photographs without colour, of dead leaves
N_LEAVES = 4  # pictures
FEWEST_PX, MOST_PX = 6.0, 64.0  # of a picture, across a patch
MOST_SHARE = 0.6  # of a picture's shorter side, across a patch
TARGET_DB, LEAST_DB = 40.0, 36.0  # what patches are coded for while atoms are learned, and how flat the flattest is
MAX_ATOMS = 8
MULTIPLIER = 0.1 * squared_error_at(TARGET_DB, PATCH_DIM) / 0.3072
FORM = AtomForm(ATOM_SIZE, SYMMETRIES)
PART = 4096  # patches of a task


def dead_leaves(rng: np.random.Generator, size: int = 768) -> np.ndarray:
    """Discs of radii with density r^-3 that hide each other, each with a slope of light, in noise of a 1/f spectrum:
    (size, size, 3) uint8."""
    picture, y, x = np.zeros((size, size, 3)), *np.mgrid[0:size, 0:size].astype(np.float32)
    for _ in range(4000):
        radius = 3.0 / np.sqrt(1 - rng.random() * (1 - (3.0 / 150) ** 2))
        cx, cy = rng.uniform(-radius, size + radius, 2)
        rows, columns = (slice(max(0, int(c - radius)), int(c + radius) + 2) for c in (cy, cx))
        inside = (x[rows, columns] - cx) ** 2 + (y[rows, columns] - cy) ** 2 < radius**2
        light = rng.uniform(10, 245) + 25 * rng.normal(size=3)
        slope = rng.normal(0, 25, 2) / radius
        ramp = slope[0] * (x[rows, columns] - cx) + slope[1] * (y[rows, columns] - cy)
        picture[rows, columns][inside] = (light + ramp[..., None])[inside]
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None])
    spectrum = np.fft.rfft2(rng.normal(size=(size, size))) / np.maximum(frequency, 1 / size)
    grain = np.fft.irfft2(spectrum, (size, size))
    return np.clip(picture + 12 * (grain / grain.std())[..., None], 0, 255).astype(np.uint8)


def patches_from(picture: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    """Patches (n, PATCH_DIM) uint8 of a picture (h, w, 3) uint8."""
    height, width, _ = picture.shape
    across = np.minimum(FEWEST_PX * (MOST_PX / FEWEST_PX) ** rng.random(n), MOST_SHARE * min(height, width))
    turn, tilt = (_rotations(angle) for angle in rng.uniform(0, 2 * np.pi, (2, n)))
    squeeze = np.zeros((n, 2, 2))
    squeeze[:, 0, 0], squeeze[:, 1, 1] = rng.uniform(0.5, 1.0, n), 1
    matrix = np.zeros((n, 3, 3))
    matrix[:, :2, :2] = across[:, None, None] / 2 * (tilt @ squeeze @ tilt.transpose(0, 2, 1) @ turn)
    margin = 0.75 * across
    matrix[:, 0, 2], matrix[:, 1, 2] = (rng.uniform(margin, size - margin) for size in (width, height))
    matrix[:, 2, 2] = 1
    return resample_patches(Window(picture, 0, 0), matrix)


def _rotations(angle: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], axis=1).reshape(-1, 2, 2)


def pictures(rng: np.random.Generator, names: tuple[str, ...], n_leaves: int) -> list[tuple[np.ndarray, float]]:
    """What patches are taken from, (h, w, 3) uint8 each, and their shares of the patches."""
    photographs = [getattr(skimage.data, name)() for name in names]
    n_grey = sum(photograph.ndim == 2 for photograph in photographs)
    found = []
    for photograph in photographs:
        grey = photograph.ndim == 2
        colour = np.repeat(photograph[..., None], 3, axis=2) if grey else photograph[..., :3]
        share = GREY / n_grey if grey else (1 - GREY - PROCEDURAL) / (len(photographs) - n_grey)
        found.append((np.ascontiguousarray(colour), share))
    return found + [(dead_leaves(rng), PROCEDURAL / n_leaves) for _ in range(n_leaves)]


def training(n: int, seed: int, names: tuple[str, ...] = PHOTOGRAPHS, n_leaves: int = N_LEAVES) -> np.ndarray:
    """Coefficients (m, 768) float32 of about n patches that an average colour does not settle, in an order by chance."""
    rng, found = np.random.default_rng(seed), []
    for picture, share in pictures(rng, names, n_leaves):
        texel = patches_from(picture, int(2.5 * n * share), rng)
        average, energy = measured(texel)
        chosen = np.flatnonzero(energy > squared_error_at(LEAST_DB, PATCH_DIM))[: int(n * share)]
        found.append(coefficients(centred(texel[chosen], average[chosen]), FORM.size))
    rows = np.concatenate(found)
    return rows[rng.permutation(len(rows))]


def learned(rows: np.ndarray, n_atoms: int, passes: int, seed: int, folder: Path) -> np.ndarray:
    """Atoms (k, 768) float32, the most used first."""
    run, made = Run(folder, SerialExecutor(), Silent()), folder / "coefficients-shipped"
    made.mkdir()
    n_parts = -(-len(rows) // PART)
    for i in range(n_parts):
        part = rows[i * PART : (i + 1) * PART]
        arrays.store(made, f"coefficient_{i}", part)
        arrays.store(made, f"rest_{i}", np.zeros(len(part), np.float32))
    work.complete(made, CoefficientsFound(n_parts, len(rows), 0.0), 0.0)
    last = run.do(DictionarySeed(made, n_atoms, seed, FORM)).folder
    for iteration in range(passes):
        record = run.do(KsvdUpdate(made, last, MAX_ATOMS, 0.0, iteration, MULTIPLIER, FORM))
        print(f"pass {iteration + 1}: squared error {record.summary.squared_error / len(rows):.4f} a patch", flush=True)
        last = record.folder
    atoms = load_atoms(last)
    uses = np.zeros(len(atoms.dictionary), np.int64)
    for i in range(n_parts):
        codes = atoms.pursue(training_part(made, i).coefficients, MAX_ATOMS, 0.0, multiplier=MULTIPLIER).codes
        taken = np.arange(codes.atom_index.shape[1]) < codes.n_atoms[:, None]
        uses += np.bincount(codes.atom_index[taken], minlength=len(uses))
    order = np.argsort(-uses.reshape(-1, FORM.n_turns).sum(axis=1), kind="stable")
    return arrays.read(last, "dictionary")[order]


def quantised(atoms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Texels (k, 16, 16, 3) int8 in whole STEPs of unit atoms (k, 768), and scales (k,) with which what is shown of
    them is a unit vector."""
    texels = texels_of(atoms, ATOM_SIZE)
    most = np.abs(texels).max(axis=1, keepdims=True)
    in_steps = STEP * np.round(texels / most * (127 // STEP)).astype(np.int8)
    shown = coefficients_of_texels(in_steps, ATOM_SIZE).astype(np.float64)
    return in_steps.reshape(-1, ATOM_SIZE, ATOM_SIZE, 3), (1 / np.linalg.norm(shown, axis=1)).astype(np.float32)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--atoms", type=int, default=512)
    parser.add_argument("--patches", type=int, default=150_000)
    parser.add_argument("--passes", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=FOLDER)
    options = parser.parse_args()
    rows = training(options.patches, options.seed)
    print(f"{len(rows)} patches, mean squared norm {(rows.astype(np.float64) ** 2).sum() / len(rows):.2f}", flush=True)
    with tempfile.TemporaryDirectory(prefix="splatpress-dictionary-") as folder:
        atoms = learned(rows, options.atoms, options.passes, options.seed, Path(folder))
    name, path = write_shipped(options.out, *quantised(atoms))
    print(f"{path}: {path.stat().st_size:,} bytes; NEWEST is {name}")


if __name__ == "__main__":
    main()
