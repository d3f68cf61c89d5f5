"""What a volume is and what is wrong with it: from its header, and from one pass over its voxels."""

from __future__ import annotations

import numpy as np

from pipeline.volumes.open import open_volume
from pipeline.volumes.volume import Choice, Volume


def summarise_volume(volume: Volume) -> dict:
    """The header of an opened volume as plain values that JSON can hold."""
    corners = np.array(
        [volume.origin, np.array(volume.origin) + np.array(volume.directions) @ (np.array(volume.shape) - 1)]
    )
    return {
        "path": volume.path,
        "kind": "volume",
        "format": volume.format,
        "shape": list(volume.shape),
        "voxels": int(np.prod(volume.shape, dtype=np.int64)),
        "dtype": str(volume.dtype),
        "spacing": list(volume.spacing),
        "unit": volume.unit,
        "frame": volume.frame,
        "first_voxel": corners[0].tolist(),
        "last_voxel": corners[1].tolist(),
        "is_labels": volume.is_labels,
        "warnings": list(volume.warnings),
        "details": volume.details,
    }


def inspect_volume(path: str, choice: Choice = Choice()) -> dict:
    """What `splatpress inspect` prints of a volume. Raises as `open_volume`."""
    return summarise_volume(open_volume(path, choice))


def check_volume(path: str, choice: Choice = Choice()) -> tuple[list[str], list[str]]:
    """Warnings and notes of a volume from one pass over its voxels. Raises InvalidScan, UnsupportedScan for what stops `compress`."""
    volume = open_volume(path, choice)
    warnings: list[str] = []
    n_unknown, low, high = 0, np.inf, -np.inf
    for slice_ in volume.slices(warnings.append):
        finite = slice_[np.isfinite(slice_)]
        n_unknown += slice_.size - finite.size
        if finite.size:
            low, high = min(low, float(finite.min())), max(high, float(finite.max()))
    if n_unknown:
        warnings.append(f"{n_unknown:,} voxels are not finite; surfaces are open around them")
    if not low < high:
        warnings.append("no voxel is finite" if not low <= high else f"all voxels are {low:g}: there is no surface")
    return [*volume.warnings, *warnings], [f"values go from {low:g} to {high:g}"] if low <= high else []
