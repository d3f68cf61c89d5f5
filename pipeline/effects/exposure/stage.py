"""The photographs as if all had been taken with one exposure."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.effects.exposure.photographs import in_one_light
from pipeline.summaries import Photographs
from storage.work import work


@dataclass(frozen=True)
class Exposed:
    """One task. Its folder stands for the ingest's wherever photographs are looked at (`photographs.py`): it has the
    fields of their gains, no pixels; its summary has the cameras."""

    ingest: Path
    log_gain: tuple  # (n_photos, 3, N_TERMS) as nested tuples
    name = "exposure"

    def init(self, folder: Path) -> int:
        return 1

    def run(self, folder: Path, index: int) -> None:
        in_one_light(folder, self.ingest, np.array(self.log_gain))

    def finalise(self, folder: Path, results: list[None]) -> Photographs:
        return work.summary(self.ingest, Photographs)
