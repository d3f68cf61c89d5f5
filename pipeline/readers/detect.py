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
from pipeline.readers.attributes.options import Position, ReadOptions
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
    """The scan as seen from the stations that were asked for, if any were."""
    by_source = options.station_by_source
    if options.station_xyz is None and not by_source:
        return source
    seen_from = partial(_from_station, by_source)
    return replace(
        source,
        stations=tuple(by_source.values()) if by_source else (options.station_xyz,),
        pieces=partial(seen_from, source.pieces),
        read_slice=source.read_slice and partial(seen_from, source.read_slice),
        settle=source.settle and partial(_settled_from_station, source.settle, options),
        warnings=(*source.warnings, *_of_source_ids(source, by_source)),
    )


def _of_source_ids(source: ScanSource, by_source: dict[int, Position]) -> list[str]:
    """What there is to say of stations that are told apart by point source ids."""
    if not by_source:
        return []
    there = source.details.get("point_source_ids")
    if there is None:
        raise UnsupportedScan(
            source.path, "no point source ids", "stations as ID=x,y,z for LAS and LAZ only; else x,y,z"
        )
    missing, others = sorted(set(by_source) - set(there)), sorted(set(there) - set(by_source))
    warnings = []
    if missing:
        warnings.append(
            f"{source.path}: no point that was looked at has the point source ids {missing}, which stations were given for"
        )
    if others:
        warnings.append(f"{source.path}: no station is known of points with the point source ids {others}")
    return warnings


def _from_station(
    by_source: dict[int, Position], read: Callable[..., Iterator[Piece]], *arguments: int
) -> Iterator[Piece]:
    """Stations stand in the order of their ids."""
    ids = np.array(list(by_source), np.int64)
    for piece in read(*arguments):
        if not len(ids):
            yield replace(piece, station=np.zeros(len(piece.position), np.int32))
            continue
        at = np.minimum(np.searchsorted(ids, piece.source_id), len(ids) - 1)
        yield replace(piece, station=np.where(ids[at] == piece.source_id, at, -1).astype(np.int32))


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
