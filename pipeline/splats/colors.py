"""The one colour of a point: the scan's own, else grey from its intensity, else that of plaster."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.summaries import ScanRead
from storage.work import arrays

# A scan with neither colour nor intensity nor photographs is plaster, which a renderer lights
# (renderer/effects/relighting.py); beside photographs, which have light in them, plaster under a lamp above and to the
# side: a flat grey would show its outline only.
PLASTER = 190
LAMP = np.array([0.42, 0.28, 0.86])
DARKEST, BRIGHTEST = 0.15, 0.85


def point_colors(scan: ScanRead, partition: Path, normal: np.ndarray, start: int, stop: int) -> np.ndarray:
    """Colours (n, 3) uint8 of the points start..stop of a partition; `scan` is the ingest's summary, `normal` (n, 3)
    turned to the viewer."""
    if arrays.exists(partition, "color"):
        return arrays.read(partition, "color", start, stop)
    if scan.is_albedo:
        return np.full((stop - start, 3), PLASTER, np.uint8)
    if scan.intensity_range is not None:
        low, high = scan.intensity_range
        intensity = arrays.read(partition, "intensity", start, stop).astype(np.float64)
        grey = np.clip(np.nan_to_num((intensity - low) / max(high - low, np.finfo(float).tiny)), 0, 1)
    else:
        grey = DARKEST + (BRIGHTEST - DARKEST) * (1 + normal @ LAMP / np.linalg.norm(LAMP)) / 2
    return np.repeat(np.round(grey * 255).astype(np.uint8)[:, None], 3, axis=1)
