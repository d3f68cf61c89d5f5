"""A volume -> its voxels as an array in slices, which later stages read by regions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.readers.files.spelling import by_name
from pipeline.summaries import VolumeRead
from pipeline.volumes.open import open_volume
from pipeline.volumes.volume import LARGEST_EXACT, Choice
from storage.errors import InvalidScan
from storage.work import arrays

CHUNK_BYTES = 1 << 22


@dataclass(frozen=True)
class ValuesSeen:
    """What the task tells of the volume."""

    low: float
    high: float
    n_unknown: int
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Voxels:
    """One task: files are compressed as one stream, so they are read once, slice by slice.

    Array: voxels (n_k, n_j, n_i) in the dtype of `Volume.dtype`, NaN where a value is not finite.

    Raises: InvalidScan where a file ends early, or no voxel is finite.
    """

    volume_path: str
    fingerprint: str  # changes when the volume's files do
    choice: Choice = Choice()
    name = "voxels"
    location_fields = ("volume_path",)

    def init(self, folder: Path) -> int:
        volume = open_volume(self.volume_path, self.choice)
        n_i, n_j, n_k = volume.shape
        slices = max(1, CHUNK_BYTES // (n_i * n_j * volume.dtype.itemsize))
        arrays.create(folder, "voxels", (n_k, n_j, n_i), str(volume.dtype), (slices, n_j, n_i))
        return 1

    def run(self, folder: Path, index: int) -> ValuesSeen:
        volume = open_volume(self.volume_path, self.choice)
        warnings: list[str] = []
        n_a_chunk = arrays.layout_of(folder, "voxels").chunks[0]
        low, high, n_unknown, first, waiting = np.inf, -np.inf, 0, 0, []
        for k, slice_ in enumerate(volume.slices(warnings.append)):
            if slice_.shape != volume.shape[1::-1]:
                raise InvalidScan(self.volume_path, f"slice {k} is {slice_.shape}", f"{volume.shape[1::-1]}")
            finite = np.isfinite(slice_)
            if not finite.all():
                slice_ = np.where(finite, slice_, np.nan).astype(slice_.dtype)
                n_unknown += int((~finite).sum())
            if finite.any():
                low, high = min(low, float(slice_[finite].min())), max(high, float(slice_[finite].max()))
            waiting.append(slice_)
            if len(waiting) == n_a_chunk or k == volume.shape[2] - 1:
                arrays.write(folder, "voxels", first, np.stack(waiting))
                first, waiting = k + 1, []
        if not low <= high:
            raise InvalidScan(self.volume_path, f"none of its {n_unknown:,} voxels is finite", "at least one value")
        if n_unknown:
            warnings.append(f"{n_unknown:,} voxels are not finite; surfaces are open around them")
        if volume.dtype.kind in "ui" and max(abs(low), abs(high)) > LARGEST_EXACT:
            warnings.append(f"values reach {max(abs(low), abs(high)):,.0f} and are taken to 24 bits")
        return ValuesSeen(
            low=low,
            high=high,
            n_unknown=n_unknown,
            warnings=tuple(by_name(text, self.volume_path) for text in (*volume.warnings, *warnings)),
        )

    def finalise(self, folder: Path, results: list[ValuesSeen]) -> VolumeRead:
        volume = open_volume(self.volume_path, self.choice)
        found = results[0]
        return VolumeRead(
            path=Path(volume.path).name,
            format=volume.format,
            shape=volume.shape,
            dtype=str(volume.dtype),
            directions=volume.directions,
            origin=volume.origin,
            spacing=volume.spacing,
            frame=volume.frame,
            unit=volume.unit,
            is_labels=volume.is_labels,
            low=found.low,
            high=found.high,
            n_unknown=found.n_unknown,
            warnings=found.warnings,
        )


def slab(voxels: Path, first: int, end: int, pad: float | None = None) -> np.ndarray:
    """Slices first..end of voxels as float32 (n_k, n_j, n_i); with `pad` as if a layer of that value lay about the
    volume, which slice 0 then is part of."""
    if pad is None:
        return arrays.read(voxels, "voxels", first, end).astype(np.float32)
    n_k, n_j, n_i = arrays.layout_of(voxels, "voxels").shape
    result = np.full((end - first, n_j + 2, n_i + 2), pad, np.float32)
    inner = range(max(first, 1), min(end, n_k + 1))
    if len(inner):
        result[inner.start - first : inner.stop - first, 1:-1, 1:-1] = arrays.read(
            voxels, "voxels", inner.start - 1, inner.stop - 1
        )
    return result
