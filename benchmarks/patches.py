"""Patches of a real scan for the benchmarks, and ratios of medians of what runs in turns."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pipeline.coding.ksvd import learn_dictionary
from pipeline.coding.quantise import dequantise_atoms, quantise_atoms
from pipeline.coding.subspace import find_components, lift, project
from pipeline.execution.executors import SerialExecutor
from pipeline.numerics.accuracy import squared_error_at
from pipeline.planning.settings import settings_for
from pipeline.texture.patches import centred
from services.processes.compress import compress
from storage.work import arrays

PAUSE_S = 0.05


class Silent:
    def begin(self, name, n_tasks): ...

    def advance(self, name, n_tasks, n_splats): ...

    def end(self, record): ...


def arguments(about: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path, help="a scan with photographs, or a work folder of `compress --work`")
    parser.add_argument("--atoms", type=int, nargs="+", default=[256, 4096])
    parser.add_argument("--patches", type=int, default=8192, help="how many are coded")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    return parser


def textured_patches(scan: Path, n: int) -> np.ndarray:
    """n patches (n, d) float32 less their averages, spread over the scan, of those that their average does not settle
    at 40 dB. Compresses the scan first where it is none of our work folders, into a folder beside it that stays."""
    found = sorted(scan.glob("resample-*"))
    if not found:
        work = Path(f"{scan.name}-work")
        compress(
            scan,
            Path(f"{scan.name}-out"),
            settings_for("draft", max_atoms=0),
            SerialExecutor(),
            Silent(),
            render=False,
            work=work,
        )
        found = sorted(work.glob("resample-*"))
    energy = arrays.read(found[-1], "energy")
    active = np.flatnonzero(energy > energy.dtype.type(0.3072))
    if len(active) < n:
        raise SystemExit(f"{scan} has {len(active)} patches with texture; {n} are needed")
    chosen = np.sort(np.random.default_rng(0).choice(active, n, replace=False))
    patches = centred(arrays.read_rows(found[-1], "texel", chosen), arrays.read_rows(found[-1], "average", chosen))
    np.random.default_rng(1).shuffle(patches)
    return patches


def seconds(work: Callable[[], object]) -> float:
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun


def in_turns(
    works: dict[str, Callable[[], object]], rounds: int, processor: dict[str, float] | None = None
) -> dict[str, float]:
    """Median seconds of each, run in turns so that a busy machine hits all alike; one round before counts not. A pause
    goes before each: threads of the last one's library (OpenBLAS, OpenMP) spin for 20 ms, on cores that are the next
    one's.

    `processor` is given the median seconds of processor time, of all threads: what a busy machine changes least.
    """
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in works}
    for round_ in range(rounds + 1):
        for name, work in works.items():
            time.sleep(PAUSE_S)
            begun = time.process_time()
            found = seconds(work), time.process_time() - begun
            if round_:
                taken[name].append(found)
    if processor is not None:
        processor.update({name: float(np.median([t[1] for t in times])) for name, times in taken.items()})
    return {name: float(np.median([t[0] for t in times])) for name, times in taken.items()}


def learned_dictionary(patches: np.ndarray, n_atoms: int) -> tuple[np.ndarray, np.ndarray]:
    """A dictionary (n_atoms, d) as the pipeline learns it for 40 dB, but in two passes, and the components (d, p)."""
    tolerance = squared_error_at(40.0, patches.shape[1])
    basis, _ = find_components(patches, tolerance / 10)
    coefficients, rest = project(patches, basis)
    atoms = learn_dictionary(
        coefficients, n_atoms, max_atoms=4, tolerance=np.maximum(tolerance - rest, 0), iterations=2
    )
    return dequantise_atoms(*quantise_atoms(lift(atoms, basis))), basis
