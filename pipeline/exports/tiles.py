"""3D Tiles 1.1: a GLB for each group of splats, coarser levels above finer ones, in a zip with `tileset.json` at root.

A tile's content is what `glb.py` writes, y up, which programs turn z up as 3D Tiles have it; boxes stand in those axes,
in metres, and hold the boxes of the tiles below. A tile's geometric error is the mean distance of its splats, their
mean radius; 0 where nothing finer stands below.

Reference: OGC 22-025r4, 3D Tiles Specification 1.1.
"""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.exports import glb
from pipeline.exports.gaussians import Gaussians
from storage.packed.schema import GROUP

_ZIP_TIME = (1980, 1, 1, 0, 0, 0)
_Z_UP = Rotation.from_matrix([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # y up to z up, as every program turns contents
_REACH = 3.0  # sigmas that a box holds


def write(
    path: Path, gaussians: Gaussians, radius: np.ndarray, parent: np.ndarray, y_up: Rotation, metres: float, unit: str
) -> None:
    """Write Gaussians of all levels, those of GROUP splats a tile, in the order of splats.

    `radius` (n_splats,) is of splats, `parent` (n_tiles,) the tile above each, -1 of the coarsest.

    Guarantees: parents' boxes hold those of their children, and their geometric errors are no smaller; the same bytes
    for the same splats.
    """
    n_tiles = len(parent)
    bounds = np.searchsorted(gaussians.splat, GROUP * np.arange(n_tiles + 1))
    parts = [gaussians.of(slice(start, stop)) for start, stop in zip(bounds, bounds[1:])]
    low, high = (np.empty((n_tiles, 3)) for _ in range(2))
    error = np.array([float(radius[i * GROUP : (i + 1) * GROUP].mean()) * metres for i in range(n_tiles)])
    has_child = np.isin(np.arange(n_tiles), parent)
    error[~has_child] = 0.0
    for i, part in enumerate(parts):
        place = (_Z_UP * y_up).apply(part.position) * metres
        reach = _REACH * part.sigma.max(axis=1, keepdims=True) * metres
        low[i], high[i] = (place - reach).min(axis=0), (place + reach).max(axis=0)
    for i in range(n_tiles - 1, -1, -1):  # children come after their parents
        if (above := parent[i]) >= 0:
            low[above], high[above] = np.minimum(low[above], low[i]), np.maximum(high[above], high[i])
            error[above] = max(error[above], error[i])
    tiles = [
        {"boundingVolume": {"box": _box(low[i], high[i])}, "geometricError": error[i], "content": {"uri": f"{i}.glb"}}
        for i in range(n_tiles)
    ]
    for i in range(n_tiles):
        if parent[i] >= 0:
            tiles[parent[i]].setdefault("children", []).append(tiles[i])
    extent = float(np.linalg.norm(high.max(axis=0) - low.min(axis=0)))
    root = {
        "boundingVolume": {"box": _box(low.min(axis=0), high.max(axis=0))},
        "geometricError": extent,
        "refine": "REPLACE",
        "children": [tile for tile, above in zip(tiles, parent) if above < 0],
    }
    extras = {"origin": list(gaussians.origin), "unit": unit}
    asset = {"version": "1.1", "generator": "splatpress", "extras": extras}
    document = {"asset": asset, "geometricError": extent, "root": root}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(zipfile.ZipInfo("tileset.json", _ZIP_TIME), json.dumps(document))
        for i, part in enumerate(parts):
            archive.writestr(zipfile.ZipInfo(f"{i}.glb", _ZIP_TIME), glb.encoded(part, y_up, metres, unit))


def _box(low: np.ndarray, high: np.ndarray) -> list[float]:
    """Middle and the three half axes of a box, as 3D Tiles have it."""
    return [*((low + high) / 2).tolist(), *np.diag((high - low) / 2).ravel().tolist()]
