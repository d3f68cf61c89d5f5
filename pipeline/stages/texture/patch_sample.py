"""A random part of the patches, as a folder that can stand for the patches'."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.numerics.hashing import uniform_hash
from pipeline.stages.texture.colors import average_colors
from pipeline.summaries import Counted
from storage.work import arrays

SEED = 9  # another choice than the training set's, whatever its seed


@dataclass(frozen=True)
class PatchSample:
    """One task. Arrays as those of `Resample`, averages and energies as those of `Colors`, of about `n_wanted` splats
    in order: fit for some thousands, in memory."""

    patches: Path
    colors: Path
    n_wanted: int
    name = "patch-sample"

    def init(self, folder: Path) -> int:
        return 1

    def run(self, folder: Path, index: int) -> Counted:
        n = arrays.layout_of(self.patches, "energy").shape[0]
        sources = {"texel": self.patches, "energy": self.colors, "point": self.patches}
        kept: dict[str, list[np.ndarray]] = {name: [] for name in (*sources, "average")}
        for block in range(arrays.n_blocks(n)):
            start, stop = arrays.block_range(block, n)
            chosen = uniform_hash(arrays.read(self.patches, "point", start, stop), SEED) < self.n_wanted / n
            for name, source in sources.items():
                kept[name].append(arrays.read(source, name, start, stop)[chosen])
            kept["average"].append(average_colors(self.colors, start, stop)[chosen])
        for name, rows in kept.items():
            joined = np.concatenate(rows)
            arrays.store(folder, name, joined)
        return Counted(sum(map(len, kept["energy"])))

    def finalise(self, folder: Path, results: list[Counted]) -> Counted:
        return Counted(results[0].n_splats)
