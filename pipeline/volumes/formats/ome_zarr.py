"""OME-Zarr (versions 0.4 and 0.5) and plain zarr arrays, read by chunks of slices; the finest of several resolutions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from pipeline.volumes.volume import Choice, Volume, checked, chosen_axis, kept_dtype, unit_of
from storage.errors import InvalidScan, UnsupportedScan
from storage.foreign import MARKS, open_store

MOST_BYTES = 1 << 28  # of a chunk's slices at a time
_NAMES = {"micrometer": "um", "nanometer": "nm", "millimeter": "mm", "meter": "m"}


def open_ome_zarr(path: str, choice: Choice = Choice()) -> Volume:
    """A volume by its attributes. Raises InvalidScan, UnsupportedScan."""
    node = open_store(path)
    if hasattr(node, "shape"):
        return _volume(
            path,
            "",
            node,
            [f"axis {i}" for i in range(node.ndim)],
            ["space"] * node.ndim,
            np.ones(node.ndim),
            np.zeros(node.ndim),
            "",
            (
                "a plain zarr array says no spacing: every voxel is taken as a cube of side 1; give --spacing I,J,K where it is not",
            ),
            choice,
        )
    attributes = dict(node.attrs)
    scales = attributes.get("ome", attributes).get("multiscales")
    if not scales:
        raise UnsupportedScan(
            path, f"a zarr group with {sorted(node.keys())[:5]} and no multiscales", "OME-Zarr, or a zarr array"
        )
    try:
        axes, dataset = scales[0]["axes"], scales[0]["datasets"][0]
        names = [a if isinstance(a, str) else a["name"] for a in axes]
        kinds = [
            ("space" if n in "zyx" else "time" if n == "t" else "channel")
            if isinstance(a, str)
            else a.get("type", "space")
            for a, n in zip(axes, names)
        ]
        units = [a.get("unit", "") for a, kind in zip(axes, kinds) if not isinstance(a, str) and kind == "space"]
        array = node[dataset["path"]]
        scale, shift = np.ones(len(axes)), np.zeros(len(axes))
        for transform in [
            *dataset.get("coordinateTransformations", []),
            *scales[0].get("coordinateTransformations", []),
        ]:
            if transform["type"] == "scale":
                scale, shift = scale * transform["scale"], shift * transform["scale"]
            elif transform["type"] == "translation":
                shift = shift + transform["translation"]
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InvalidScan(
            f"{path}:multiscales",
            "an entry that is missing, or of another kind",
            "axes, datasets and their transformations",
        ) from error
    if len(set(units)) > 1:
        raise UnsupportedScan(f"{path}:axes", f"units {units}", "one unit for all axes of space")
    return _volume(path, dataset["path"], array, names, kinds, scale, shift, units[0] if units else "", (), choice)


def _volume(path, inner, array, names, kinds, scale, shift, unit, warnings, choice) -> Volume:
    space = [a for a, kind in enumerate(kinds) if kind == "space"]
    if len(space) != 3 or array.ndim != len(names):
        raise UnsupportedScan(f"{path}:axes", f"{names} of {array.shape}", "three axes of space")
    chosen = {
        a: chosen_axis(path, kinds[a], array.shape[a], choice.time if kinds[a] == "time" else choice.component)
        for a in range(array.ndim)
        if a not in space
    }
    if array.dtype.kind not in "uif":
        raise UnsupportedScan(f"{path}:{inner}", f"voxels of {array.dtype}", "numbers of 8 to 64 bits")
    along = space[::-1]  # i, j, k: the last axis is the fastest
    kept = kept_dtype(array.dtype)
    details = {"array": inner, "axes": names, "dtype": str(array.dtype), "chunks": list(array.chunks)}
    files = tuple(sorted(str(p) for p in Path(path).rglob("*") if p.name in (*MARKS, ".zattrs")))
    return checked(
        Volume(
            path,
            "zarr",
            tuple(array.shape[a] for a in along),
            kept,
            _Chunks(path, inner, tuple(space), tuple(chosen.items()), kept),
            tuple(map(tuple, np.diag(scale[along]).tolist())),
            tuple(shift[along].tolist()),
            unit=unit_of(_NAMES.get(unit, unit)),
            warnings=warnings,
            details=details,
            files=files,
        ),
        choice,
    )


class _Chunks:
    """Slices, read as many at a time as a chunk has."""

    def __init__(
        self, path: str, inner: str, space: tuple[int, ...], chosen: tuple[tuple[int, int], ...], kept: np.dtype
    ) -> None:
        self._path, self._inner, self._space, self._chosen, self._kept = path, inner, space, dict(chosen), kept

    def __call__(self, warn: Callable[[str], None]) -> Iterator[np.ndarray]:
        node = open_store(self._path)
        array = node[self._inner] if self._inner else node
        k = self._space[0]
        a_slice = int(np.prod([array.shape[a] for a in self._space[1:]], dtype=np.int64)) * array.dtype.itemsize
        step = max(1, min(array.chunks[k], MOST_BYTES // a_slice))
        for first in range(0, array.shape[k], step):
            index = tuple(
                slice(first, first + step) if a == k else self._chosen.get(a, slice(None)) for a in range(array.ndim)
            )
            try:
                block = np.asarray(array[index])
            except Exception as error:
                if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno):
                    raise
                raise InvalidScan(
                    self._path,
                    f"chunks of slices from {first} on cannot be read",
                    "a whole store",
                ) from error
            yield from (np.ascontiguousarray(slice_, self._kept) for slice_ in block)
