"""Which patches the dictionary is learned from: a part of those that their average colour does not settle, chosen by
hash within octaves of contrast (`contrast_octaves.py`), as coefficients of principal components
(`pipeline/coding/subspace.py`)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.coding.grid import coefficients
from pipeline.coding.ksvd import BLOCK as TASK_SPLATS
from pipeline.coding.omp_kernels import squared_norms
from pipeline.coding.subspace import HALF, find_components, halves_suffice, project
from pipeline.numerics.accuracy import psnr_db
from pipeline.numerics.hashing import uniform_hash
from pipeline.stages.texture.colors import average_colors
from pipeline.stages.texture.contrast_octaves import octave_of, shares
from pipeline.stages.texture.resample import n_coarser_of
from pipeline.stages.texture.texels import points_of, texel_rows
from pipeline.summaries import AverageColors, CoefficientsFound, InParts, SubspaceFound, Training
from pipeline.texture.patches import centred
from storage.packed.schema import ATOM_SIZES, PATCH_SIZE
from storage.work import arrays, work

ROWS = 1024  # patches in float32 at a time: 12 MiB
AT_ONCE = 64 * arrays.BLOCK  # splats that a task looks at together: 40 MB, whatever the size of the scan
# Of the training set, patches that nothing is learned from, so that they tell what others lose, and what share of it they
# may be: by their mean error, known to about 2 %, the Lagrange multiplier is found. By patches that were learned from
# `balanced` of fountain_p11 ended 0.10 dB below what its target promises.
HELD, MOST_HELD = 4096, 0.25
SHOWN = 512  # of a task's patches, chosen by chance: what tells how much atoms of a size leave of them


class TrainingPart(NamedTuple):
    """The patches of one task, in components."""

    coefficients: np.ndarray  # (m, p) float32
    rest: np.ndarray  # (m,) float64: squared norm of what the components leave of each


@dataclass(frozen=True)
class PatchesChosen:
    """What a task tells of its patches: squared norms are sums."""

    n_splats: int
    n_active: int
    cutoff_error: float
    n_shown: int
    beyond: list[float]  # by size of atoms
    settled_energy: float


class _Looked(NamedTuple):
    """What was found among some splats: those chosen, and sums of all."""

    chosen: np.ndarray  # (m,) int64
    draw: np.ndarray  # (m,) float64
    luck: np.ndarray  # (m,) float64
    average: np.ndarray  # (m, 3) float32
    n_active: int
    cutoff_error: float
    settled_energy: float


@dataclass(frozen=True)
class TrainingSet:
    """A task a range of blocks, about TASK_SPLATS patches each. Arrays of task t: texel_<t>, average_<t>, luck_<t> (m,)
    float64, the hash as a share of what its octave is taken below: who is below a half is a half of the set, of each
    octave.

    A splat of the finest level is taken if a hash of its point's place in the scan's files and the seed says so, and
    patches are in the order of that hash: neither depends on tasks or workers, nor on chunks, which turn with the scan.
    """

    patches: Path
    colors: Path
    tolerance: float  # squared error at which a patch needs no atom
    n_wanted: int
    seed: int
    cutoff: float  # squared error of a patch at the target: the summary has what would be left were no patch above it
    name = "training-set"

    def init(self, folder: Path) -> int:
        counts = np.array(work.summary(self.colors, AverageColors).census)
        share = shares(counts, self.tolerance, self.n_wanted)
        work.write_json(folder / "share.json", {"n_splats": int(counts.sum()), "share": share.tolist()})
        return max(1, min(arrays.n_blocks(int(counts.sum())), -(-int(counts @ share) // TASK_SPLATS)))

    def run(self, folder: Path, index: int) -> PatchesChosen:
        plan, n_tasks = work.read_json(folder / "share.json"), work.read_json(folder / "plan.json")["n_tasks"]
        n, share = plan["n_splats"], np.array(plan["share"])
        rows = [min(n, arrays.n_blocks(n) * i // n_tasks * arrays.BLOCK) for i in (index, index + 1)]
        first = n_coarser_of(self.patches)
        looked = [
            self._look(share, at, min(at + AT_ONCE, first + rows[1]))
            for at in range(first + rows[0], first + rows[1], AT_ONCE)
        ] or [self._look(share, first + rows[0], first + rows[0])]
        chosen, draw, luck, average = (
            np.concatenate([getattr(part, k) for part in looked]) for k in ("chosen", "draw", "luck", "average")
        )
        order = np.argsort(draw)
        texel = texel_rows(self.patches, chosen)
        for name, taken in (("texel", texel), ("average", average)):
            arrays.store(folder, f"{name}_{index}", taken[order], taken.shape)
        arrays.store(folder, f"luck_{index}", luck[order], luck.shape)
        shown = _patches(folder, index, slice(SHOWN))
        beyond = [
            0.0 if s == PATCH_SIZE else float((squared_norms(shown) - squared_norms(coefficients(shown, s))).sum())
            for s in ATOM_SIZES
        ]
        return PatchesChosen(
            n_splats=len(chosen),
            n_active=sum(part.n_active for part in looked),
            cutoff_error=sum(part.cutoff_error for part in looked),
            n_shown=len(shown),
            beyond=beyond,
            settled_energy=sum(part.settled_energy for part in looked),
        )

    def _look(self, share: np.ndarray, start: int, stop: int) -> _Looked:
        """Which of splats start..stop are chosen, and what there is to know of the others."""
        energy = arrays.read(self.colors, "energy", start, stop)
        active, octave = energy > self.tolerance, octave_of(energy)
        draw = uniform_hash(points_of(self.patches, start, stop), self.seed)
        chosen = np.flatnonzero(active & (draw < share[octave]))
        return _Looked(
            chosen=start + chosen,
            draw=draw[chosen],
            luck=draw[chosen] / np.maximum(share[octave[chosen]], 1e-300),
            average=self._averages(start + chosen),
            n_active=int(active.sum()),
            cutoff_error=float(np.minimum(energy, self.cutoff).sum(dtype=np.float64)),
            settled_energy=float(energy[~active].sum(dtype=np.float64)),
        )

    def _averages(self, rows: np.ndarray) -> np.ndarray:
        """Average colours (m, 3) of the splats `rows` (m,), ascending."""
        blocks, firsts = np.unique(rows // arrays.BLOCK, return_index=True)
        found = [np.empty((0, 3), np.float32)]
        for block, first, end in zip((blocks * arrays.BLOCK).tolist(), firsts, [*firsts[1:], len(rows)]):
            found.append(average_colors(self.colors, block, block + arrays.BLOCK)[rows[first:end] - block])
        return np.concatenate(found)

    def finalise(self, folder: Path, results: list[PatchesChosen]) -> Training:
        return Training(
            n_tasks=len(results),
            n_patches=sum(r.n_splats for r in results),
            n_splats=work.read_json(folder / "share.json")["n_splats"],
            n_active=sum(r.n_active for r in results),
            cutoff_error=sum(r.cutoff_error for r in results),
            settled_energy=sum(r.settled_energy for r in results),
            beyond=self._beyond(results),
        )

    @staticmethod
    def _beyond(results: list[PatchesChosen]) -> dict[str, float]:
        """By size of atoms, the squared norm that they leave of a patch of this set on average, whatever their
        number."""
        n = max(1, sum(r.n_shown for r in results))
        return {str(size): max(0.0, sum(r.beyond[i] for r in results) / n) for i, size in enumerate(ATOM_SIZES)}


@dataclass(frozen=True)
class PartProjected:
    """What a task tells of its patches: the squared norm that is left beyond the space."""

    n_splats: int
    rest: float


@dataclass(frozen=True)
class Components:
    """The training set in its principal components, a task a task of it.

    Arrays: basis (d, p) float32; of task t: coefficient_<t> (m, p) float16, or float32 where that would be felt, and
    rest_<t> (m,) float32. `floor` is what the components may leave of a patch on average, a squared norm.
    """

    training: Path
    floor: float
    name = "components"

    def init(self, folder: Path) -> int:
        n_tasks = work.summary(self.training, InParts).n_tasks
        share = -(-2 * HALF // n_tasks)
        sample = np.concatenate([_patches(self.training, task, slice(share)) for task in range(n_tasks)])
        basis, left = find_components(sample, self.floor)
        dtype = "float16" if halves_suffice(sample @ basis, self.floor) else "float32"
        arrays.store(folder, "basis", basis, basis.shape)
        work.write_json(folder / "components.json", {"n_components": basis.shape[1], "dtype": dtype, "left": left})
        return n_tasks

    def run(self, folder: Path, index: int) -> PartProjected:
        basis, dtype = arrays.read(folder, "basis"), work.read_json(folder / "components.json")["dtype"]
        n = arrays.layout_of(self.training, f"average_{index}").shape[0]
        coefficients, rest = np.empty((n, basis.shape[1]), np.float32), np.empty(n)
        for at in range(0, n, ROWS):
            rows = slice(at, at + ROWS)
            coefficients[rows], rest[rows] = project(_patches(self.training, index, rows), basis)
        for name, values in (("coefficient", coefficients.astype(dtype)), ("rest", rest.astype(np.float32))):
            arrays.store(folder, f"{name}_{index}", values, values.shape)
        return PartProjected(n_splats=n, rest=float(rest.sum()))

    def finalise(self, folder: Path, results: list[PartProjected]) -> SubspaceFound:
        found = work.read_json(folder / "components.json")
        n = sum(r.n_splats for r in results)
        floor = psnr_db(sum(r.rest for r in results), n * arrays.layout_of(folder, "basis").shape[0])
        return SubspaceFound(len(results), n, found["n_components"], found["dtype"], floor)


@dataclass(frozen=True)
class Coefficients:
    """The training set as coefficients of what atoms of a size can show, a task a task of it; arrays as `Components`
    but for the basis, and held_coefficient_<t>, held_rest_<t> of the patches that nothing is learned from: those of the
    highest luck, for the first atoms are patches of the lowest. Patches are in the order of their luck: the first share
    of a part is that share of each of its octaves."""

    training: Path
    size: int
    name = "coefficients"

    def init(self, folder: Path) -> int:
        return work.summary(self.training, InParts).n_tasks

    def run(self, folder: Path, index: int) -> PartProjected:
        luck = arrays.read(self.training, f"luck_{index}")
        held = luck >= 1 - held_share(work.summary(self.training, Training).n_patches)
        n = len(luck)
        values, rest = np.empty((n, 3 * self.size**2), np.float32), np.empty(n, np.float32)
        for at in range(0, n, ROWS):
            rows = slice(at, at + ROWS)
            patches = _patches(self.training, index, rows)
            values[rows] = coefficients(patches, self.size)
            rest[rows] = np.maximum(squared_norms(patches) - squared_norms(values[rows]), 0)
        order = np.argsort(luck, kind="stable")
        n_learned = n - int(held.sum())
        for prefix, chosen in (("", order[:n_learned]), ("held_", order[n_learned:])):
            for name, stored in (("coefficient", values[chosen]), ("rest", rest[chosen])):
                arrays.store(folder, f"{prefix}{name}_{index}", stored, stored.shape)
        return PartProjected(n_splats=int(n - held.sum()), rest=float(rest[~held].sum(dtype=np.float64)))

    def finalise(self, folder: Path, results: list[PartProjected]) -> CoefficientsFound:
        n, rest = (sum(getattr(r, k) for r in results) for k in ("n_splats", "rest"))
        return CoefficientsFound(len(results), n, rest)


def held_share(n_patches: int) -> float:
    """What share of a training set of so many patches nothing is learned from."""
    return min(MOST_HELD, HELD / max(1, n_patches))


def stands_for(chosen: Path, energy: np.ndarray) -> np.ndarray:
    """For how many of a scan's patches each of the training set stands, (n,) float64, by squared norms (n,): octaves of
    contrast with few patches are in the set whole."""
    share = np.array(work.read_json(chosen / "share.json")["share"])
    return 1 / share[octave_of(energy)].clip(share[share > 0].min())


def training_part(folder: Path, index: int, share: float = 1.0) -> TrainingPart:
    """The patches of one task of `Components` or `Coefficients`; or the first of them, `share` of all."""
    n = math.ceil(share * arrays.layout_of(folder, f"rest_{index}").shape[0])
    coefficients = arrays.read(folder, f"coefficient_{index}", 0, n).astype(np.float32, copy=False)
    return TrainingPart(coefficients, arrays.read(folder, f"rest_{index}", 0, n).astype(np.float64))


def first_coefficients(folder: Path, index: int, n: int) -> np.ndarray:
    """Those of the first `n` patches of a task, or of all where there are fewer; no other row is read."""
    return arrays.read(folder, f"coefficient_{index}", 0, n).astype(np.float32, copy=False)


def n_tasks_of(folder: Path, share: float) -> int:
    """Tasks that look at a `share` of each part, as many patches each as a part has."""
    return math.ceil(work.summary(folder, InParts).n_tasks * share)


def training_share(folder: Path, index: int, share: float) -> TrainingPart:
    """The patches of task `index` of as many: of each part that it has, the first, `share` of all."""
    n_parts, n_tasks = work.summary(folder, InParts).n_tasks, n_tasks_of(folder, share)
    parts = range(n_parts * index // n_tasks, n_parts * (index + 1) // n_tasks)
    found = [training_part(folder, part, share) for part in parts]
    return found[0] if len(found) == 1 else TrainingPart(*map(np.concatenate, zip(*found)))


def held_part(folder: Path, index: int) -> TrainingPart:
    """The patches of one task of `Coefficients` that nothing is learned from."""
    coefficients, rest = (arrays.read(folder, f"held_{name}_{index}") for name in ("coefficient", "rest"))
    return TrainingPart(coefficients, rest.astype(np.float64))


def _patches(training: Path, index: int, rows: slice) -> np.ndarray:
    texel, average = (
        arrays.read(training, f"{name}_{index}", rows.start or 0, rows.stop) for name in ("texel", "average")
    )
    return centred(texel, average)
