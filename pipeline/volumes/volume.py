"""What every reader of volumes returns: a header, and the voxels slice by slice.

Axes: voxel (i, j, k) stands at `origin + directions @ (i, j, k)` in the file's own frame and unit; i is the fastest in the
file, k the slowest. Positions keep that frame: nothing is turned to another one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from storage.errors import InvalidScan, UnsupportedScan

LARGEST_EXACT = 1 << 24  # of whole numbers in float32
SHEAR = 1e-4  # cosine of an angle between axes from which on they are told to be oblique to each other
_UNITS = {
    "mm": "millimetre",
    "millimeter": "millimetre",
    "cm": "centimetre",
    "m": "metre",
    "meter": "metre",
    "um": "micrometre",
    "microns": "micrometre",
    "micron": "micrometre",
    "µm": "micrometre",
    "nm": "nanometre",
    "": "unknown",
}


@dataclass(frozen=True)
class Choice:
    """What a file may leave open, and a user say: one of several volumes in it, and how far its voxels lie apart."""

    component: int | None = None
    time: int | None = None
    spacing: tuple[float, float, float] | None = None  # along i, j, k, in place of the file's


@dataclass(frozen=True)
class Volume:
    """An opened volume: its header has been read and checked, its voxels have not.

    `slices(warn)` yields the voxels (n_j, n_i) of each k in turn, in `dtype`, and calls `warn` with what it only then finds.
    """

    path: str
    format: str  # "nrrd" | "nifti" | "metaimage" | "tiff" | "zarr" | "raw"
    shape: tuple[int, int, int]  # along i, j, k
    dtype: np.dtype  # of the voxels as they are kept
    slices: Callable[[Callable[[str], None]], Iterator[np.ndarray]]
    directions: tuple[tuple[float, float, float], ...] = (
        (1.0, 0.0, 0.0),
        (0.0, 1.0, 0.0),
        (0.0, 0.0, 1.0),
    )  # rows of the matrix
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    frame: str = "the file's own"  # as "left-posterior-superior"
    unit: str = "unknown"
    is_labels: bool = False  # the header says that values are names of regions
    warnings: tuple[str, ...] = ()
    details: dict = field(default_factory=dict)
    files: tuple[str, ...] = ()  # all that it is read from, the header first

    @property
    def spacing(self) -> tuple[float, float, float]:
        """Distances of neighbouring voxels along i, j, k, unit."""
        return tuple(np.linalg.norm(self.directions, axis=0).tolist())


def unit_of(name: str) -> str:
    """The name of a unit of length as the report has it.

    >>> unit_of("mm"), unit_of(" Microns "), unit_of("furlong")
    ('millimetre', 'micrometre', 'furlong')
    """
    return _UNITS.get(name.strip().lower(), name.strip())


def kept_dtype(dtype: np.dtype, scaled: bool = False) -> np.dtype:
    """What voxels of a dtype are kept as: themselves up to 32 bits, else float32; float32 where slope and intercept change them."""
    dtype = np.dtype(dtype)
    if scaled or dtype.kind == "f" or dtype.itemsize > 4:
        return np.dtype(np.float32)
    return dtype.newbyteorder("=")


def checked(volume: Volume, choice: Choice) -> Volume:
    """The volume with the spacing that was asked for.

    Raises: InvalidScan where an axis has fewer than 2 voxels, or directions make no frame; UnsupportedScan for voxels that are no numbers.
    """
    if volume.dtype.kind not in "uif":
        raise UnsupportedScan(
            f"{volume.path}:type", f"voxels of type {volume.dtype}", "whole numbers of 8 to 64 bits, float32, float64"
        )
    if min(volume.shape) < 2:
        raise InvalidScan(
            f"{volume.path}:sizes", " x ".join(map(str, volume.shape)), "at least 2 voxels along each axis"
        )
    matrix = np.array(volume.directions, np.float64)
    if choice.spacing is not None:
        length = np.linalg.norm(matrix, axis=0)
        if not (np.isfinite(length).all() and (length > 0).all()):
            matrix, length = np.eye(3), np.ones(3)
        volume = replace(
            volume,
            directions=tuple(map(tuple, (matrix / length * choice.spacing).tolist())),
            warnings=(
                *volume.warnings,
                f"the spacing is {choice.spacing} as asked for, not the file's {length.tolist()}",
            ),
        )
        matrix = np.array(volume.directions)
    if not np.isfinite(matrix).all() or not np.isfinite(volume.origin).all():
        raise InvalidScan(
            f"{volume.path}:directions",
            f"{matrix.tolist()} from {volume.origin}",
            "finite numbers",
            "give --spacing I,J,K",
        )
    length = np.linalg.norm(matrix, axis=0)
    if not (length > 0).all() or abs(np.linalg.det(matrix / np.where(length > 0, length, 1))) < 1e-3:
        raise InvalidScan(
            f"{volume.path}:directions",
            f"axes {matrix.T.tolist()}",
            "three axes that are not 0 nor in one plane",
            "give --spacing I,J,K",
        )
    return replace(volume, warnings=(*volume.warnings, *_notes_on_axes(matrix, volume.unit)))


def _notes_on_axes(matrix: np.ndarray, unit: str) -> Iterator[str]:
    length = np.linalg.norm(matrix, axis=0)
    cosine = (matrix / length).T @ (matrix / length)
    for a, b in ((0, 1), (0, 2), (1, 2)):
        if abs(cosine[a, b]) > SHEAR:
            tilt = 90 - np.degrees(np.arccos(np.clip(cosine[a, b], -1, 1)))
            yield f"axes {'ijk'[a]} and {'ijk'[b]} are {abs(tilt):.2f} degrees off a right angle, as of a tilted gantry; taken as they are"
    if length.max() > 1.01 * length.min():
        yield f"spacing differs by axis: {', '.join(f'{x:g}' for x in length)} {unit}"


def chosen_axis(path: str, kind: str, n: int, asked: int | None) -> int:
    """Which of `n` entries of an axis that is not of space to take. Raises UnsupportedScan where that was left open."""
    argument = "--time" if kind == "time" else "--component"
    what = "times" if kind == "time" else "components a voxel"
    if asked is None:
        if n > 1:
            raise UnsupportedScan(path, f"{n} {what}", "one number a voxel", f"choose one with {argument} 0..{n - 1}")
        return 0
    if not 0 <= asked < n:
        raise InvalidScan(path, f"{argument} {asked}", f"0 to {n - 1}")
    return asked


def spacing_from_positions(path: str, position: np.ndarray) -> tuple[float, list[str]]:
    """Distance of slices (n,) that say where they stand, and what is wrong with it."""
    steps = np.array([b - a for a, b in pairwise(position)])
    step = float(np.median(steps))
    if not (steps > 0).all():
        raise InvalidScan(path, "slices that do not ascend along their axis", "slices in the order of their positions")
    off = np.flatnonzero(np.abs(steps - step) > 0.01 * step)
    return step, [
        f"slices {i} and {i + 1} lie {steps[i]:g} apart, others {step:g}: one may be missing" for i in off[:3]
    ]
