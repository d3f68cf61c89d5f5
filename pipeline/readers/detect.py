"""Which reader a path belongs to."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from pipeline.readers.attributes.looks import Looks
from pipeline.readers.attributes.options import ReadOptions
from pipeline.readers.container import open_container
from pipeline.readers.files.spelling import shown
from pipeline.readers.points import HANDLED, READERS, open_points
from pipeline.scan import Piece, ScanSource
from storage import place
from storage.errors import InvalidScan, UnsupportedScan


def handled_suffixes() -> tuple[str, ...]:
    """Of the files that some reader takes."""
    return (".zip", *READERS)


def _open(path: Path, options: ReadOptions) -> ScanSource:
    if path.is_dir() or (path.suffix.lower() == ".zip" and path.is_file()):
        return open_container(str(path), options)
    if not path.is_file():
        raise UnsupportedScan(shown(str(path)), "neither a file nor a folder", HANDLED)
    return open_points(str(path), options)


def _with_station(source: ScanSource, options: ReadOptions) -> ScanSource:
    """The scan as seen from the station that was asked for, if one was."""
    if options.station_xyz is None:
        return source
    return replace(
        source,
        stations=(options.station_xyz,),
        pieces=partial(_from_station, source.pieces),
        read_slice=source.read_slice and partial(_from_station, source.read_slice),
        settle=source.settle and partial(_settled_from_station, source.settle, options),
    )


def _from_station(read: Callable[..., Iterator[Piece]], *arguments: int) -> Iterator[Piece]:
    for piece in read(*arguments):
        yield replace(piece, station=np.zeros(len(piece.position), np.int32))


def _settled_from_station(
    settle: Callable[[Looks], ScanSource | None], options: ReadOptions, looks: Looks
) -> ScanSource | None:
    settled = settle(looks)
    return settled and _with_station(settled, options)


def open_scan(path: str | os.PathLike, options: ReadOptions = ReadOptions()) -> ScanSource:
    """Opens a scan of any handled format by its header.

    Guarantees: pixels are not read, and points only as samples that tell what colours range over; the source can be pickled, and its pieces read any number of times.
    Raises: FileNotFoundError where there is nothing at `path`; InvalidScan for a scan that breaks its format or has no
    points; UnsupportedScan for a format that is not handled.
    """
    path = place.held(Path(path))
    if not path.exists():
        raise FileNotFoundError(errno.ENOENT, "no such scan", str(path))
    source = _with_station(_open(path, options), options)
    if source.n_points == 0:
        raise InvalidScan(shown(str(path)), "an empty scan, 0 points", "at least one point")
    return source
