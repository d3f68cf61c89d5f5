"""Which patches the dictionary is learned from: a random part of those that their average colour does not settle."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.coding.ksvd import BLOCK as TASK_SPLATS
from pipeline.texture.patches import centred
from storage import arrays, work


@dataclass(frozen=True)
class TrainingSet:
    """A task a range of blocks, about TASK_SPLATS patches each. Arrays of task t: texel_<t>, average_<t>.

    A splat is taken if a hash of its index and the seed says so, so the choice depends on neither tasks nor workers.
    """

    patches: Path
    tolerance: float
    n_wanted: int
    seed: int
    name = "training-set"

    def init(self, folder: Path) -> int:
        n = arrays.opened(self.patches, "energy").shape[0]
        n_active, settled_energy = 0, 0.0
        for block in range(arrays.n_blocks(n)):
            energy = self._energy(block, n)
            active = energy > self.tolerance
            n_active += int(active.sum())
            settled_energy += float(energy[~active].sum(dtype=np.float64))
        work.write_json(folder / "share.json", {
            "n_splats": n, "n_active": n_active, "settled_energy": settled_energy,
            "share": min(1.0, self.n_wanted / max(1, n_active)),
        })
        return max(1, min(arrays.n_blocks(n), -(-min(self.n_wanted, n_active) // TASK_SPLATS)))

    def run(self, folder: Path, index: int) -> dict:
        n = arrays.opened(self.patches, "energy").shape[0]
        n_tasks = work.read_json(folder / "plan.json")["n_tasks"]
        share = work.read_json(folder / "share.json")["share"]
        texel, average = [], []
        for block in range(*(arrays.n_blocks(n) * i // n_tasks for i in (index, index + 1))):
            start, stop = arrays.block_range(block, n)
            chosen = (self._energy(block, n) > self.tolerance) & (uniform_hash(start, stop, self.seed) < share)
            texel.append(arrays.read(self.patches, "texel", start, stop)[chosen])
            average.append(arrays.read(self.patches, "average", start, stop)[chosen])
        for name, rows in (("texel", np.concatenate(texel)), ("average", np.concatenate(average))):
            arrays.store(folder, f"{name}_{index}", rows, rows.shape)
        return {"n_splats": sum(map(len, average))}

    def finalise(self, folder: Path, results: list[dict]) -> dict:
        share = work.read_json(folder / "share.json")
        return {"n_tasks": len(results), "n_patches": sum(r["n_splats"] for r in results), **share}

    def _energy(self, block: int, n: int) -> np.ndarray:
        return arrays.read(self.patches, "energy", *arrays.block_range(block, n))


def training_patches(folder: Path, index: int) -> np.ndarray:
    """The patches of one task, less their averages, (m, d) float32."""
    return centred(arrays.read(folder, f"texel_{index}"), arrays.read(folder, f"average_{index}"))


def uniform_hash(start: int, stop: int, seed: int) -> np.ndarray:
    """A number in [0, 1) for each of the indices start..stop, by splitmix64 of index and seed (Steele et al. 2014)."""
    with np.errstate(over="ignore"):
        z = np.arange(start, stop, dtype=np.uint64) + np.uint64(seed) * np.uint64(0xD1342543DE82EF95)
        z = (z + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z ^= z >> np.uint64(31)
    return (z >> np.uint64(11)) / 2.0**53
