"""TIFF stacks through tifffile: the pages of one file, or a folder of files in natural order, one a slice.

Spacing is what ImageJ or OME wrote into the file; plain TIFF says at most how wide a pixel is.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import tifffile

from pipeline.volumes.volume import Choice, Volume, checked, chosen_axis, kept_dtype, unit_of
from storage.errors import InvalidScan, SplatpressError, UnsupportedScan

SUFFIXES = (".tif", ".tiff")
_AXIS_KINDS = {"T": "time", "C": "component", "S": "component"}


def natural_key(name: str) -> list:
    """By which names stand in natural order.

    >>> sorted(["s10.tif", "s9.tif", "S1.tif"], key=natural_key)
    ['S1.tif', 's9.tif', 's10.tif']
    """
    return [(0, int(part), "") if part.isdigit() else (1, 0, part.lower()) for part in re.split(r"(\d+)", name) if part]


def slices_in(folder: Path) -> list[Path]:
    """The TIFF files of a folder in natural order of their names."""
    return sorted(
        (p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith(".")),
        key=lambda p: natural_key(p.name),
    )


def open_tiff(path: str, choice: Choice = Choice()) -> Volume:
    """A volume by its headers. Raises InvalidScan, UnsupportedScan."""
    if Path(path).is_dir():
        return _open_folder(path, choice)
    with _opened(path) as tif:
        series = tif.series[0]
        axes, sizes, dtype = series.axes, series.shape, series.dtype
        spacing, unit, warnings = _spacing(tif)
    space = [a for a, name in enumerate(axes) if name not in _AXIS_KINDS][-3:]
    if len(space) != 3:
        raise UnsupportedScan(
            path, f"axes {axes} of {'x'.join(map(str, sizes))}", "a stack of pages, or a folder of files"
        )
    chosen = {}
    for axis, size in enumerate(sizes):
        if axis not in space:
            kind = _AXIS_KINDS.get(axes[axis], "component")
            chosen[axis] = chosen_axis(path, kind, size, choice.time if kind == "time" else choice.component)
    kept = kept_dtype(dtype)
    return _volume(
        path,
        tuple(sizes[a] for a in reversed(space)),
        kept,
        _Pages(path, sizes, tuple(space), tuple(chosen.items()), kept),
        spacing,
        unit,
        warnings,
        {"axes": axes, "dtype": str(dtype)},
        (path,),
        choice,
    )


def _open_folder(path: str, choice: Choice) -> Volume:
    files = slices_in(Path(path))
    first = None
    for file in files:
        with _opened(str(file)) as tif:
            page = tif.pages[0]
            found = (page.shape, page.dtype, page.samplesperpixel)
            if len(tif.pages) != 1:
                raise UnsupportedScan(
                    str(file),
                    f"{len(tif.pages)} pages in a folder of {len(files)} files",
                    "one page a file, or one file of pages",
                )
            if first is None:
                first = found
                spacing, unit, warnings = _spacing(tif)
            elif found != first:
                raise InvalidScan(
                    str(file), f"{found[0]} pixels of {found[1]}", f"{first[0]} of {first[1]}, as {files[0].name} has"
                )
    shape, dtype, n_samples = first
    component = None
    if n_samples > 1:
        component = chosen_axis(path, "component", n_samples, choice.component)
    kept = kept_dtype(dtype)
    slices = _Files(tuple(map(str, files)), component, kept)
    height, width = [n for n in shape if n_samples == 1 or n != n_samples][:2] if len(shape) > 2 else shape
    return _volume(
        path,
        (width, height, len(files)),
        kept,
        slices,
        spacing,
        unit,
        warnings,
        {"files": len(files), "first": files[0].name, "last": files[-1].name, "dtype": str(dtype)},
        tuple(map(str, files)),
        choice,
    )


def _volume(path, shape, kept, slices, spacing, unit, warnings, details, files, choice) -> Volume:
    directions = tuple(map(tuple, np.diag(spacing).tolist()))
    return checked(
        Volume(
            path, "tiff", shape, kept, slices, directions, unit=unit, warnings=warnings, details=details, files=files
        ),
        choice,
    )


@contextmanager
def _opened(path: str) -> Iterator[tifffile.TiffFile]:
    """An opened file; whatever tifffile and its codecs raise on broken bytes becomes InvalidScan."""
    try:
        with tifffile.TiffFile(path) as tif:
            yield tif
    except (SplatpressError, MemoryError, GeneratorExit):
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno:
            raise
        raise InvalidScan(path, "cannot be read", "a whole TIFF file", "it may be truncated") from error


class _Pages:
    """The pages of one file, by plane of the chosen entries."""

    def __init__(
        self,
        path: str,
        sizes: tuple[int, ...],
        space: tuple[int, ...],
        chosen: tuple[tuple[int, int], ...],
        kept: np.dtype,
    ) -> None:
        self._path, self._sizes, self._space, self._chosen, self._kept = path, sizes, space, dict(chosen), kept

    def __call__(self, warn: Callable[[str], None]) -> Iterator[np.ndarray]:
        k_axis, j_axis, _ = self._space
        with _opened(self._path) as tif:
            series = tif.series[0]
            n_pages = int(np.prod(self._sizes[: len(self._sizes) - len(series.keyframe.shape)], dtype=np.int64))
            if len(series.pages) < n_pages:  # one contiguous piece that only its first page describes
                whole = tifffile.memmap(self._path, series=0, mode="r")
                for k in range(self._sizes[k_axis]):
                    index = tuple(
                        k if a == k_axis else self._chosen.get(a, slice(None)) for a in range(len(self._sizes))
                    )
                    yield np.ascontiguousarray(whole[index], self._kept)
                return
            outer = self._sizes[: len(self._sizes) - len(series.keyframe.shape)]
            for k in range(self._sizes[k_axis]):
                index = tuple(k if a == k_axis else self._chosen.get(a, 0) for a in range(len(outer)))
                page = _page(self._path, series.pages[int(np.ravel_multi_index(index, outer))])  # type: ignore[arg-type]
                inner = tuple(self._chosen.get(a, slice(None)) for a in range(len(outer), len(self._sizes)))
                yield np.ascontiguousarray(page[inner], self._kept)


class _Files:
    """One page of each file."""

    def __init__(self, files: tuple[str, ...], component: int | None, kept: np.dtype) -> None:
        self._files, self._component, self._kept = files, component, kept

    def __call__(self, warn: Callable[[str], None]) -> Iterator[np.ndarray]:
        for file in self._files:
            with _opened(file) as tif:
                page = tif.pages[0]
                pixels = _page(file, page)
                if self._component is not None:
                    pixels = pixels[self._component] if page.planarconfig == 2 else pixels[..., self._component]
                yield np.ascontiguousarray(pixels, self._kept)


def _page(path: str, page) -> np.ndarray:
    if page is None:
        raise InvalidScan(path, "a page is missing", "a whole file", "it may be truncated")
    return page.asarray()


def _spacing(tif: tifffile.TiffFile) -> tuple[tuple[float, float, float], str, tuple[str, ...]]:
    """Along i, j, k; and what was not said."""
    if tif.ome_metadata:
        pixels = next(
            (
                e
                for e in ElementTree.fromstring(tif.ome_metadata).iter()
                if e.tag.endswith("}Pixels") or e.tag == "Pixels"
            ),
            None,
        )
        found = [pixels.get(f"PhysicalSize{a}") if pixels is not None else None for a in "XYZ"]
        if all(found):
            return tuple(map(float, found)), unit_of(pixels.get("PhysicalSizeXUnit", "um")), ()  # type: ignore[return-value]
    page, told = tif.pages[0], tif.imagej_metadata or {}
    width, height = (_pixel_size(page, name) for name in ("XResolution", "YResolution"))
    if told.get("spacing") and width and height:
        return (
            (width, height, abs(float(told["spacing"]))),
            unit_of(str(told.get("unit", "")).replace("\\u00B5", "u")),
            (),
        )
    return (
        (1.0, 1.0, 1.0),
        "unknown",
        (
            "no spacing of slices is said: every voxel is taken as a cube of side 1; give --spacing I,J,K where it is not",
        ),
    )


def _pixel_size(page, name: str) -> float | None:
    tag = page.tags.get(name)
    if tag is None or not tag.value[0] or not tag.value[1]:
        return None
    return tag.value[1] / tag.value[0]
