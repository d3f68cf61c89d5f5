"""DICOM series: a folder of files of one slice each, through pydicom.

Slices stand by their positions (ImagePositionPatient), never by names or numbers. A tilted gantry shears the volume: its third axis goes
from slice to slice, whatever the plane. Where slices are missing there are voxels that are not finite, so that surfaces are open there and
all others in their places. Values are `slope * pixel + intercept` of each slice. Files of several frames are not handled.

References: DICOM PS3.3, C.7.6.2 (Image Plane), C.11.1 (Modality LUT).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pydicom
from pydicom.errors import InvalidDicomError

from pipeline.volumes.volume import Choice, Volume, checked, chosen_axis, kept_dtype
from storage.errors import InvalidScan, SplatpressError, UnsupportedScan

SUFFIX = ".dcm"
MAGIC_AT, MAGIC = 128, b"DICM"
UNEVEN = 0.01  # of the step, from which on slices do not lie evenly
MOST_MISSING = 4  # times the slices there are
FRAME = "left-posterior-superior"
_TAGS = [
    "SeriesInstanceUID", "SeriesDescription", "Modality", "Rows", "Columns", "PixelSpacing", "ImageOrientationPatient", "ImagePositionPatient",
    "InstanceNumber", "AcquisitionNumber", "TemporalPositionIdentifier", "RescaleSlope", "RescaleIntercept", "SamplesPerPixel", "NumberOfFrames",
    "PhotometricInterpretation", "BitsAllocated", "PixelRepresentation",
]  # fmt: skip


@dataclass(frozen=True)
class _Slice:
    """What the header of a file says."""

    file: str
    series: str
    modality: str
    shape: tuple[int, int]  # rows, columns
    spacing: tuple[float, float]  # of rows, of columns
    rows_and_columns: tuple[float, ...]  # 6: the direction of a row's pixels, then of a column's
    position: tuple[float, float, float]
    order: tuple[int, ...]  # of several at one place
    slope: float
    intercept: float
    samples: int
    dtype: str


def _is_dicom(file: Path) -> bool:
    """By the first bytes."""
    with open(file, "rb") as opened:
        return opened.read(MAGIC_AT + len(MAGIC))[MAGIC_AT:] == MAGIC


def open_dicom(path: str, choice: Choice = Choice()) -> Volume:
    """A volume by the headers of its slices. Raises InvalidScan, UnsupportedScan."""
    folder = Path(path)
    files = sorted(p for p in folder.iterdir() if p.is_file()) if folder.is_dir() else [folder]
    found = {file.name: _header(file) if _is_dicom(file) else None for file in files}
    slices = [one for one in found.values() if one is not None]
    left_out = [name for name, one in found.items() if one is None]
    if not slices:
        raise InvalidScan(path, f"{len(files)} files, none of which has DICOM pixels", "a folder of slices")
    _check_alike(path, slices)
    first = slices[0]
    along, down = np.array(first.rows_and_columns).reshape(2, 3)
    place = np.array([one.position for one in slices]) @ np.cross(along, down)
    order = sorted(range(len(slices)), key=lambda i: (place[i], slices[i].order, slices[i].file))
    stack = _one_time(path, [slices[i] for i in order], place[order], choice.time)
    component = chosen_axis(path, "component", first.samples, choice.component) if first.samples > 1 else None
    lattice = _lattice(path, stack, np.cross(along, down))
    matrix = np.stack([along * first.spacing[1], down * first.spacing[0], lattice.step], axis=1)
    rescaled = any((one.slope, one.intercept) != (1.0, 0.0) for one in stack)
    kept = kept_dtype(np.dtype(first.dtype), scaled=rescaled or -1 in lattice.of_plane)
    volume = Volume(
        path, "dicom", (first.shape[1], first.shape[0], len(lattice.of_plane)), kept,
        _Slices(tuple(stack), lattice.of_plane, component, kept),
        tuple(map(tuple, matrix.tolist())), stack[0].position, FRAME, "millimetre",
        is_labels=first.modality == "SEG", warnings=(*_said(left_out), *lattice.warnings),
        details={"modality": first.modality, "slices": len(stack), "missing": lattice.of_plane.count(-1), "rescaled": rescaled, "dtype": first.dtype},
        files=tuple(one.file for one in stack),
    )  # fmt: skip
    return checked(volume, choice)


def _header(file: Path) -> _Slice | None:
    """None of a file without pixels, as a DICOMDIR."""
    try:
        head = pydicom.dcmread(file, stop_before_pixels=True, specific_tags=_TAGS)
        if "Rows" not in head:
            return None
        if int(head.get("NumberOfFrames") or 1) > 1:
            raise UnsupportedScan(
                str(file), f"a file of {int(head.NumberOfFrames)} frames", "files of one slice each, or NRRD or NIfTI"
            )
        if (kind := str(head.get("PhotometricInterpretation", ""))) == "PALETTE COLOR":
            raise UnsupportedScan(str(file), f"pixels of {kind}", "one number a pixel")
        missing = [n for n in ("PixelSpacing", "ImageOrientationPatient", "ImagePositionPatient") if not head.get(n)]
        if missing:
            raise InvalidScan(
                str(file), f"no {', '.join(missing)}", "slices that say where they lie", "they may be no CT or MR"
            )
        sign, bits = "iu"[int(head.get("PixelRepresentation", 0)) == 0], int(head.get("BitsAllocated", 16))
        return _Slice(
            str(file),
            str(head.get("SeriesInstanceUID", "")),
            str(head.get("Modality", "")),
            (int(head.Rows), int(head.Columns)),
            tuple(map(float, head.PixelSpacing)),  # type: ignore[arg-type]
            tuple(map(float, head.ImageOrientationPatient)),
            tuple(map(float, head.ImagePositionPatient)),  # type: ignore[arg-type]
            tuple(int(head.get(n) or 0) for n in ("TemporalPositionIdentifier", "AcquisitionNumber", "InstanceNumber")),
            float(head.get("RescaleSlope", 1) or 1),
            float(head.get("RescaleIntercept", 0) or 0),
            int(head.get("SamplesPerPixel", 1)),
            f"{sign}{max(8, bits) // 8}",
        )
    except (SplatpressError, MemoryError):
        raise
    except Exception as error:  # of pydicom's parsers: broken bytes raise whatever they break
        raise InvalidScan(str(file), f"its header cannot be read ({str(error)[:200]})", "a DICOM file") from error


def _said(left_out: list[str]) -> list[str]:
    more = ", ..." if len(left_out) > 3 else ""
    return (
        [f"{len(left_out)} files have no DICOM pixels and are left out: {', '.join(left_out[:3])}{more}"]
        if left_out
        else []
    )


def _check_alike(path: str, slices: list[_Slice]) -> None:
    series = Counter(one.series for one in slices)
    if len(series) > 1:
        said = ", ".join(f"{n} files of ...{uid[-12:]}" for uid, n in series.most_common(4))
        raise UnsupportedScan(path, f"{len(series)} series ({said})", "one", "put the files of one into a folder")
    for name in ("shape", "spacing", "rows_and_columns", "samples", "dtype"):
        values = [getattr(one, name) for one in slices]
        off = [i for i, v in enumerate(values) if not np.allclose(v, values[0], atol=1e-4)] if name not in ("dtype", "shape") else [
            i for i, v in enumerate(values) if v != values[0]]  # fmt: skip
        if off:
            what = re.sub("_", " ", name)
            raise InvalidScan(slices[off[0]].file, f"{what} {values[off[0]]}", f"{values[0]}, as {slices[0].file} has")


def _one_time(path: str, stack: list[_Slice], place: np.ndarray, time: int | None) -> list[_Slice]:
    """Of several slices at each place the one of the time that is chosen."""
    begins = np.concatenate([[True], np.diff(place) > 1e-3])
    counts = np.diff([*np.flatnonzero(begins), len(place)])
    if counts.min() != counts.max():
        raise InvalidScan(
            path, f"{counts.min()} to {counts.max()} slices at one place", "as many at every place, as of times"
        )
    chosen = chosen_axis(path, "time", int(counts[0]), time)
    return stack[chosen :: int(counts[0])]


@dataclass(frozen=True)
class _Lattice:
    """Where slices stand."""

    step: np.ndarray  # (3,) from one to the next
    of_plane: tuple[int, ...]  # the slice of each plane, -1 where none is
    warnings: tuple[str, ...]


def _lattice(path: str, stack: list[_Slice], normal: np.ndarray) -> _Lattice:
    position = np.array([one.position for one in stack])
    if len(stack) < 2:
        return _Lattice(normal, (0,) * len(stack), ())
    steps = np.diff(position @ normal)
    usual = float(np.median(steps))
    n = np.rint(steps / usual).astype(int)
    plane = np.concatenate([[0], np.cumsum(np.maximum(n, 1))])
    if plane[-1] >= (1 + MOST_MISSING) * len(stack):
        raise InvalidScan(path, f"gaps of {plane[-1] + 1 - len(stack):,} slices between {len(stack)}", "a whole series")
    step = (position[-1] - position[0]) / plane[-1]
    off = np.linalg.norm(position - position[0] - plane[:, None] * step, axis=1)
    warnings = [
        f"{k - 1} slices are missing after {Path(stack[i].file).name}, {steps[i]:g} mm on where others lie {usual:g} apart: surfaces are open there"
        for i, k in enumerate(n)
        if k > 1
    ][:3]
    if off.max() > UNEVEN * usual:
        warnings.append(
            f"slices lie up to {off.max():.3g} mm off where even ones would; taken as even, {np.linalg.norm(step):.4g} mm apart"
        )
    of_plane = np.full(plane[-1] + 1, -1)
    of_plane[plane] = np.arange(len(stack))
    return _Lattice(step, tuple(of_plane.tolist()), tuple(warnings))


@dataclass(frozen=True)
class _Slices:
    """Slice by slice, in the order of their places."""

    stack: tuple[_Slice, ...]
    of_plane: tuple[int, ...]
    component: int | None
    kept: np.dtype

    def __call__(self, warn: Callable[[str], None]) -> Iterator[np.ndarray]:
        for at in self.of_plane:
            one = self.stack[max(at, 0)]
            if at < 0:
                yield np.full(one.shape, np.nan, self.kept)
                continue
            pixels = _pixels(one.file)
            if self.component is not None:
                pixels = pixels[..., self.component]
            if pixels.shape != one.shape:
                raise InvalidScan(one.file, f"pixels of {pixels.shape}", f"{one.shape}, as its header says")
            if (one.slope, one.intercept) != (1.0, 0.0):
                pixels = pixels * one.slope + one.intercept
            yield np.ascontiguousarray(pixels, self.kept)


def _pixels(file: str) -> np.ndarray:
    try:
        read = pydicom.dcmread(file)
    except (InvalidDicomError, ValueError, EOFError) as error:
        raise InvalidScan(file, f"cannot be read ({str(error)[:200]})", "a DICOM file") from error
    try:
        return read.pixel_array
    except (NotImplementedError, RuntimeError) as error:
        syntax = read.file_meta.TransferSyntaxUID.name
        raise UnsupportedScan(file, f"pixels coded as {syntax}", "uncompressed, deflated or run-length coded ones",
                              "convert the series, for example to NRRD") from error  # fmt: skip
    except (ValueError, AttributeError, EOFError) as error:
        raise InvalidScan(
            file, f"its pixels cannot be read ({str(error)[:200]})", "a whole file", "it may be truncated"
        ) from error
