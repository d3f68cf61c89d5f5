"""What every reader returns: a scan's header, its points in pieces, its photographs one by one.

Units and axes: positions in the scan's own unit (named in `unit`), float64 and absolute; cameras look along +z of
their own frame, x right, y down, and the centre of a photo's first pixel is (0.5, 0.5), as in COLMAP.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from pipeline.readers.attributes.looks import Look, Looks
from storage.packed.schema import Camera

__all__ = ["Camera", "Piece", "ScanSource"]


@dataclass(frozen=True)
class Piece:
    """A run of consecutive points. Rows correspond; what a scan lacks is None."""

    position: np.ndarray  # (n, 3) float64, absolute; may hold NaN, which the ingest counts and drops
    normal: np.ndarray | None = None  # (n, 3) float32, any length; zero or NaN means none
    color: np.ndarray | None = None  # (n, 3) uint8, sRGB; black where the file has NaN
    colorless: np.ndarray | None = None  # (n,) bool: where that is; None where the file cannot have it
    intensity: np.ndarray | None = None  # (n,) float32 in the file's own range
    visible_count: np.ndarray | None = None  # (n,) int64: how many cameras see each point
    visible_camera: np.ndarray | None = None  # (sum(visible_count),) int32 positions in ScanSource.cameras
    station: np.ndarray | None = None  # (n,) int32 positions in ScanSource.stations; -1 for none
    source_id: np.ndarray | None = None  # (n,) int64: a LAS file's point source ids
    look: tuple[int, Look] | None = None  # what its values say of part i of the scan, where only a sample was looked at
    mark: np.ndarray | None = None  # (n,) uint8: why a point is left out (readers.marks.NUMBER), 0 where it is not


@dataclass(frozen=True)
class ScanSource:
    """An opened scan: the header has been read and checked, the points have not.

    `pieces(max_points)` streams the points in file order, at most `max_points` a piece, and may be called again;
    `read_slice(first, stop, max_points)` so streams a run of them, without reading those before it.
    `read_photo(i)` returns photo i as uint8 sRGB `(height, width, 3)`, of the size that `cameras[i]` states.
    """

    path: str
    format: str  # "colmap" | "ply" | "las" | "e57"
    n_points: int
    pieces: Callable[[int], Iterator[Piece]]
    read_slice: Callable[[int, int, int], Iterator[Piece]] | None = (
        None  # points first..stop; None: only from the start
    )
    slice_rows: int = 1  # slices that begin at multiples of it read nothing twice
    # What was decided from a sample is checked against all points: the scan as the Looks of all pieces have it, None
    # where that is as it is. None itself where nothing was decided from a sample.
    settle: Callable[[Looks], ScanSource | None] | None = None
    unit: str = "unknown"  # "metre", "foot", "US survey foot", "unknown", ...
    cameras: tuple[Camera, ...] = ()
    read_photo: Callable[[int], np.ndarray] | None = None
    stations: tuple[tuple[float, float, float], ...] = ()  # scanner positions, absolute
    has_normals: bool = False
    has_colors: bool = False
    has_intensity: bool = False
    intensity_range: tuple[float, float] | None = None  # as the header declares it, if it does
    has_visibility: bool = False  # False with cameras: found by a depth test
    bounds: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None  # as the header declares it
    position_step: float | None = None  # by which coordinates can differ at least; None: that of `position_type`
    position_type: str = "float64"  # or "float32": what the file keeps coordinates as
    is_single: bool = False  # every coordinate of a piece is a float32
    warnings: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()  # properties that the file has and that are not used
    details: dict = field(default_factory=dict)  # what `inspect` shows besides: versions, point formats, CRS
