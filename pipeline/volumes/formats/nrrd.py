"""NRRD, attached and detached: the header through pynrrd, the voxels as a stream.

A detached header (`.nhdr`) names a data file, a list of them, or a pattern with numbers; lines and bytes of each may be
skipped. Space directions are one vector an axis, `none` for an axis that is not of space.

References: Teem, "Definition of NRRD File Format" (teem.sourceforge.net/nrrd/format.html).
"""

from __future__ import annotations

import os
from pathlib import Path

import nrrd
import numpy as np
from nrrd.errors import NRRDError

from pipeline.volumes.formats.stream import Slices, Stream, check_length, numbered_files
from pipeline.volumes.volume import Choice, Volume, checked, chosen_axis, kept_dtype, unit_of
from storage.errors import InvalidScan, UnsupportedScan

MAX_LINE_BYTES = 1 << 16
MAX_LINES = 1 << 16
# Bits of each of NRRD's types; a type more is no number of ours.
_TYPES = {
    **dict.fromkeys(("signed char", "int8", "int8_t"), "i1"),
    **dict.fromkeys(("uchar", "unsigned char", "uint8", "uint8_t"), "u1"),
    **dict.fromkeys(("short", "short int", "signed short", "signed short int", "int16", "int16_t"), "i2"),
    **dict.fromkeys(("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"), "u2"),
    **dict.fromkeys(("int", "signed int", "int32", "int32_t"), "i4"),
    **dict.fromkeys(("uint", "unsigned int", "uint32", "uint32_t"), "u4"),
    **dict.fromkeys(
        ("longlong", "long long", "long long int", "signed long long", "signed long long int", "int64", "int64_t"), "i8"
    ),
    **dict.fromkeys(("ulonglong", "unsigned long long", "unsigned long long int", "uint64", "uint64_t"), "u8"),
    "float": "f4",
    "double": "f8",
}
_ENCODINGS = {
    "raw": "raw",
    "gzip": "gzip",
    "gz": "gzip",
    "bzip2": "bzip2",
    "bz2": "bzip2",
    **dict.fromkeys(("ascii", "text", "txt"), "text"),
}
_OF_SPACE = ("domain", "space")
_SPACES = {"RAS": "right-anterior-superior", "LAS": "left-anterior-superior", "LPS": "left-posterior-superior"}


def open_nrrd(path: str, choice: Choice = Choice()) -> Volume:
    """A volume by its header. Raises InvalidScan, UnsupportedScan."""
    header, data_files, n_header = _header(path)
    sizes = tuple(int(n) for n in header["sizes"])
    dtype, encoding = _dtype(path, header), _encoding(path, header)
    space, others = _axes(path, header, sizes)
    chosen = tuple(
        (axis, chosen_axis(path, kind, sizes[axis], choice.time if kind == "time" else choice.component))
        for axis, kind in others
    )
    skip_bytes = _whole(path, header, "byte skip", "byteskip", -1)
    if skip_bytes < 0 and encoding != "raw":
        raise UnsupportedScan(f"{path}:byte skip", f"-1 with encoding {encoding}", "-1 with raw voxels only")
    skip_lines = _whole(path, header, "line skip", "lineskip", 0)
    if not data_files and skip_bytes >= 0 and not skip_lines:
        stream_skip, paths = (n_header + skip_bytes, 0), (path,)
    else:
        stream_skip, paths = (skip_bytes, skip_lines), data_files or (path,)  # type: ignore[assignment]
    if not data_files and encoding in ("gzip", "bzip2", "text") or (not data_files and skip_lines):
        # Voxels of an attached header begin at its end: its lines are skipped before anything is decompressed.
        stream_skip = (skip_bytes, skip_lines + _n_lines(path, n_header))
    stream = Stream(paths, dtype, sizes, space, chosen, encoding, stream_skip[1], stream_skip[0])
    if int(np.prod([sizes[a] for a in range(space[2], len(sizes))])) % len(paths):
        raise InvalidScan(
            f"{path}:data file", f"{len(paths)} files for {sizes[space[2]]} slices", "as many slices in each"
        )
    directions, origin, frame, unit, warnings = _frame(path, header, space)
    kept = kept_dtype(dtype)
    details = {
        k: str(header[k]) for k in ("content", "type", "encoding", "endian", "space", "sample units") if k in header
    }
    volume = Volume(
        path,
        "nrrd",
        tuple(sizes[a] for a in space),  # type: ignore[arg-type]
        kept,
        Slices(stream, kept),
        directions,
        origin,
        frame,
        unit,
        warnings=(*check_length(stream), *warnings),
        details=details,
        files=tuple(dict.fromkeys((path, *paths))),
    )
    return checked(volume, choice)


def _header(path: str) -> tuple[dict, tuple[str, ...], int]:
    """Fields by name, the data files of a detached header, and the bytes of the header."""
    lines, n_bytes = [], 0  # type: ignore[var-annotated]
    with open(path, "rb") as file:
        while len(lines) < MAX_LINES:
            line = file.readline(MAX_LINE_BYTES)
            n_bytes += len(line)
            if not line.strip():
                break
            lines.append(line.decode("utf-8", "replace"))
    of_list = next(
        (i for i, line in enumerate(lines) if line.lower().replace(" ", "").startswith("datafile:list")), len(lines)
    )
    try:
        header = nrrd.read_header(lines[:of_list])
    except (NRRDError, ValueError, StopIteration, TypeError) as error:
        raise InvalidScan(path, "its header cannot be read", "a NRRD header") from error
    for name in ("type", "dimension", "sizes", "encoding"):
        if name not in header:
            raise InvalidScan(f"{path}:{name}", "missing", "every NRRD header has it")
    if len(header["sizes"]) != header["dimension"] or min(header["sizes"]) < 1:
        raise InvalidScan(
            f"{path}:sizes", f"{list(header['sizes'])} of dimension {header['dimension']}", "as many sizes of 1 or more"
        )
    return header, _data_files(path, header, [line.strip() for line in lines[of_list + 1 :]]), n_bytes


def _data_files(path: str, header: dict, listed: list[str]) -> tuple[str, ...]:
    named = header.get("data file", header.get("datafile", ""))
    names = listed or ([named] if named else [])
    words = named.split()
    if not listed and len(words) in (4, 5) and "%" in words[0]:
        names = numbered_files(f"{path}:data file", *words[:4])
    files = tuple(os.path.join(os.path.dirname(path), name) for name in names)
    for file in files:
        if not Path(file).is_file():
            raise InvalidScan(f"{path}:data file", f"{file} is not there", "the data file beside its header")
    return files


def _n_lines(path: str, n_header: int) -> int:
    with open(path, "rb") as file:
        return file.read(n_header).count(b"\n")


def _dtype(path: str, header: dict) -> np.dtype:
    name = _TYPES.get(str(header["type"]).lower())
    if name is None:
        raise UnsupportedScan(f"{path}:type", f"{header['type']!r}", "numbers of 8 to 64 bits")
    endian = str(header.get("endian", "")).lower()
    if np.dtype(name).itemsize > 1 and _encoding(path, header) != "text" and endian not in ("big", "little"):
        raise InvalidScan(f"{path}:endian", repr(endian) if endian else "missing", "big or little")
    return np.dtype((">" if endian == "big" else "<") + name)


def _encoding(path: str, header: dict) -> str:
    encoding = _ENCODINGS.get(str(header["encoding"]).lower())
    if encoding is None:
        raise UnsupportedScan(f"{path}:encoding", f"{header['encoding']!r}", "raw, gzip, bzip2, ascii")
    return encoding


def _whole(path: str, header: dict, name: str, other: str, least: int) -> int:
    value = header.get(name, header.get(other, 0))
    if value < least:
        raise InvalidScan(f"{path}:{name}", f"{value}", f"{least} or more")
    return value


def _axes(path: str, header: dict, sizes: tuple[int, ...]) -> tuple[tuple[int, int, int], list[tuple[int, str]]]:
    """The three axes of space, and what each other one is: "time" or "component"."""
    n = len(sizes)
    kinds = [k.lower() for k in header.get("kinds", ["???"] * n)]
    directions = header.get("space directions")
    if directions is not None and len(directions) == n:
        space = [a for a in range(n) if np.isfinite(np.atleast_1d(directions[a])).all()]
    elif n == 3 and not any(kind not in (*_OF_SPACE, "???", "none") for kind in kinds):
        space = [0, 1, 2]
    else:
        space = [a for a in range(n) if kinds[a] in _OF_SPACE]
        if len(space) != 3:
            space = [a for a in range(n) if sizes[a] > 1] if sum(size > 1 for size in sizes) == 3 else list(range(n))
    if len(space) != 3:
        raise UnsupportedScan(
            f"{path}:kinds",
            f"{len(space)} axes of space in sizes {list(sizes)}",
            "three, told by kinds or space directions",
        )
    others = [(a, "time" if kinds[a] == "time" else "component") for a in range(n) if a not in space]
    return (space[0], space[1], space[2]), others


def _frame(path: str, header: dict, space: tuple[int, int, int]) -> tuple:
    warnings: list[str] = []
    named = str(header.get("space", ""))
    frame = _SPACES.get(named.upper(), named) or "the file's own"
    directions = header.get("space directions")
    if directions is not None:
        rows = np.array([np.atleast_1d(directions[a]) for a in space], np.float64)
        if rows.shape != (3, 3):
            raise UnsupportedScan(f"{path}:space directions", f"{rows.shape[1]} numbers an axis", "3")
        matrix, origin = rows.T, np.array(header.get("space origin", np.zeros(3)), np.float64)
        if origin.shape != (3,):
            raise InvalidScan(f"{path}:space origin", f"{origin.tolist()}", "3 numbers")
    else:
        spacing = np.array([_at(header, "spacings", a, np.nan) for a in space], np.float64)
        if np.isnan(spacing).any():
            warnings.append(
                "the header says no spacing: every voxel is taken as a cube of side 1; give --spacing I,J,K where it is not"
            )
            spacing = np.where(np.isnan(spacing), 1.0, spacing)
        lowest = np.nan_to_num([_at(header, "axis mins", a, _at(header, "axismins", a, 0.0)) for a in space])
        in_cells = [
            str(_at(header, "centerings", a, "node")).lower() == "cell" and bool(low) for a, low in zip(space, lowest)
        ]
        matrix, origin = np.diag(spacing), lowest + np.where(in_cells, spacing / 2, 0)
    units = header.get("space units") or [u for a, u in enumerate(header.get("units", [])) if a in space]
    if len(set(units)) > 1:
        raise UnsupportedScan(f"{path}:units", f"{units}", "one unit for all axes")
    unit = unit_of(units[0]) if units else "millimetre" if frame.endswith("superior") else "unknown"
    return tuple(map(tuple, matrix.tolist())), tuple(origin.tolist()), frame, unit, tuple(warnings)


def _at(header: dict, name: str, axis: int, otherwise):
    values = header.get(name)
    return otherwise if values is None or axis >= len(values) else values[axis]
