"""The photographs as if all had been taken with one exposure."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.effects.exposure.light import relit
from pipeline.summaries import Photographs
from storage.work import arrays, work

TILE = 512


@dataclass(frozen=True)
class Exposed:
    """A task a photograph. Arrays photo_<i> (h, w, 3) uint8; its summary has the cameras, so that its folder can stand
    for the ingest's wherever photographs are looked at."""

    ingest: Path
    log_gain: tuple  # (n_photos, 3, N_TERMS) as nested tuples
    name = "exposure"

    def init(self, folder: Path) -> int:
        for i, camera in enumerate(work.summary(self.ingest, Photographs).cameras):
            arrays.create(folder, f"photo_{i}", (camera.height_px, camera.width_px, 3), "uint8", (TILE, TILE, 3))
        return len(self.log_gain)

    def run(self, folder: Path, index: int) -> None:
        photo = arrays.read(self.ingest, f"photo_{index}")
        arrays.write_picture(folder, f"photo_{index}", relit(photo, np.array(self.log_gain[index])))

    def finalise(self, folder: Path, results: list[None]) -> Photographs:
        return work.summary(self.ingest, Photographs)
