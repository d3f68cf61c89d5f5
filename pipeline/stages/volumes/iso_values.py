"""Voxels -> which iso values they propose."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.summaries import VolumeRead
from pipeline.volumes.proposals import BINS, Proposal, Spectrum, bin_edges, labels_in, propose, spectrum_of
from storage.work import arrays, work

SLICES = 32  # a task


@dataclass(frozen=True)
class IsoProposed:
    """The histogram of a volume by bins of values, and what it proposes, best first."""

    edges: tuple[float, ...]  # (BINS + 1,)
    voxels: tuple[int, ...]
    pairs: tuple[int, ...]  # of neighbours that pass the bin
    steepness: tuple[float, ...]  # mean difference of these
    is_labels: bool  # values look like names of regions
    proposals: tuple[Proposal, ...]


@dataclass(frozen=True)
class SpectrumPart:
    """What a task tells of its slices: a count or sum a bin of values."""

    voxels: list[float]
    pairs: list[float]
    steps: list[float]


@dataclass(frozen=True)
class IsoValues:
    """A task SLICES slices, and the first one of the next."""

    voxels: Path
    name = "iso-values"

    def init(self, folder: Path) -> int:
        return -(-work.summary(self.voxels, VolumeRead).shape[2] // SLICES)

    def run(self, folder: Path, index: int) -> SpectrumPart:
        first = index * SLICES
        voxels = arrays.read(self.voxels, "voxels", first, first + SLICES + 1)
        found = spectrum_of(voxels, SLICES, self._edges())
        return SpectrumPart(found.voxels.tolist(), found.pairs.tolist(), found.steps.tolist())

    def finalise(self, folder: Path, results: list[SpectrumPart]) -> IsoProposed:
        volume = work.summary(self.voxels, VolumeRead)
        total = {name: np.sum([getattr(r, name) for r in results], axis=0) for name in ("voxels", "pairs", "steps")}
        spectrum = Spectrum(self._edges(), **total)
        is_whole = np.dtype(volume.dtype).kind in "ui"
        is_labels = volume.is_labels or labels_in(spectrum, is_whole) is not None
        steepness = np.divide(total["steps"], total["pairs"], out=np.zeros(BINS), where=total["pairs"] > 0)
        return IsoProposed(
            edges=tuple(spectrum.edges.tolist()),
            voxels=tuple(spectrum.voxels.tolist()),
            pairs=tuple(spectrum.pairs.tolist()),
            steepness=tuple(steepness.tolist()),
            is_labels=bool(is_labels),
            proposals=tuple(propose(spectrum, is_labels)),
        )

    def _edges(self) -> np.ndarray:
        volume = work.summary(self.voxels, VolumeRead)
        return bin_edges(volume.low, volume.high, np.dtype(volume.dtype).kind in "ui")
