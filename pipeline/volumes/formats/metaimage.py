"""MetaImage, `.mha` and `.mhd`: a header of `name = value` lines, voxels after it or in files beside it.

`TransformMatrix` holds the direction of each axis in turn; ITK, whose format this is, keeps positions in millimetres, left-posterior-superior.

References: ITK, MetaIO documentation (itk.org/Wiki/MetaIO/Documentation).
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from pipeline.volumes.formats.stream import Slices, Stream, check_length, numbered_files
from pipeline.volumes.volume import Choice, Volume, checked, chosen_axis, kept_dtype
from storage.errors import InvalidScan, UnsupportedScan

MAX_LINE_BYTES, MAX_LINES = 1 << 14, 1 << 12
_TYPES = {"MET_CHAR": "i1", "MET_UCHAR": "u1", "MET_SHORT": "i2", "MET_USHORT": "u2", "MET_INT": "i4", "MET_UINT": "u4",
          "MET_LONG": "i4", "MET_ULONG": "u4", "MET_LONG_LONG": "i8", "MET_ULONG_LONG": "u8", "MET_FLOAT": "f4",
          "MET_DOUBLE": "f8"}  # fmt: skip
_FRAME = "left-posterior-superior"


def open_metaimage(path: str, choice: Choice = Choice()) -> Volume:
    """A volume by its header. Raises InvalidScan, UnsupportedScan."""
    fields, n_header, n_lines = _header(path)
    n_dims = int(_numbers(path, fields, "NDims", 1)[0])
    if n_dims not in (3, 4):
        raise UnsupportedScan(f"{path}:NDims", f"{n_dims} dimensions", "3, or 4 with --time")
    sizes = tuple(int(n) for n in _numbers(path, fields, "DimSize", n_dims))
    if min(sizes) < 1:
        raise InvalidScan(f"{path}:DimSize", f"{list(sizes)}", "sizes of 1 or more")
    channels = int(_numbers(path, fields, "ElementNumberOfChannels", 1, (1,))[0])
    chosen = [(0, chosen_axis(path, "component", channels, choice.component))]
    if n_dims == 4:
        chosen.append((4, chosen_axis(path, "time", sizes[3], choice.time)))
    type_ = fields.get("elementtype", "").upper()
    if type_ not in _TYPES:
        raise UnsupportedScan(f"{path}:ElementType", repr(type_), f"one of {', '.join(_TYPES)}")
    is_big = _yes(fields, "elementbyteordermsb") or _yes(fields, "binarydatabyteordermsb")
    dtype = np.dtype((">" if is_big else "<") + _TYPES[type_])
    files = _data_files(path, fields)
    skip = int(_numbers(path, fields, "HeaderSize", 1, (0,))[0]) if files else n_header
    is_packed, is_text = _yes(fields, "compresseddata"), not _yes(fields, "binarydata", True)
    if is_text and not files:
        raise UnsupportedScan(
            f"{path}:BinaryData", "numbers as text after the header", "binary, or text in a file beside it"
        )
    if skip < 0 and (is_packed or is_text):
        raise UnsupportedScan(
            f"{path}:HeaderSize", "-1 of data that are compressed or text", "-1 with binary voxels only"
        )
    if sizes[2] * (sizes[3] if n_dims == 4 else 1) % max(1, len(files)):
        raise InvalidScan(
            f"{path}:ElementDataFile", f"{len(files)} files for {sizes[2]} slices", "as many slices in each"
        )
    encoding = "zlib" if is_packed else "text" if is_text else "raw"
    lines, skip = (n_lines, 0) if is_packed and not files else (0, skip)
    stream = Stream(files or (path,), dtype, (channels, *sizes), (1, 2, 3), tuple(chosen), encoding, lines, skip)
    directions, origin, notes = _frame(path, fields, n_dims)
    kept = kept_dtype(dtype)
    volume = Volume(
        path,
        "metaimage",
        sizes[:3],  # type: ignore[arg-type]
        kept,
        Slices(stream, kept),
        directions,
        origin,
        _FRAME,
        "millimetre",
        warnings=(*check_length(stream), *notes),
        details={"type": type_, "compressed": str(is_packed)},
        files=tuple(dict.fromkeys((path, *files))),
    )
    return checked(volume, choice)


def _header(path: str) -> tuple[dict[str, str], int, int]:
    """Fields by name in small letters, with the names of a list of files in `listed`; the bytes of the header, and its lines."""
    fields: dict[str, str] = {}
    with open(path, "rb") as file:
        for n_lines in range(1, MAX_LINES):
            line = file.readline(MAX_LINE_BYTES)
            name, equals, value = line.decode("utf-8", "replace").partition("=")
            if not equals:
                raise InvalidScan(path, f"a line {line[:40]!r} before ElementDataFile", "NAME = VALUE")
            fields[name.strip().lower()] = value.strip()
            if name.strip().lower() == "elementdatafile":
                if value.split()[:1] == ["LIST"]:
                    listed = [
                        file.readline(MAX_LINE_BYTES).decode("utf-8", "replace").strip() for _ in range(MAX_LINES)
                    ]
                    fields["listed"] = "\n".join(name for name in listed if name)
                return fields, file.tell(), n_lines
    raise InvalidScan(path, f"no ElementDataFile in {MAX_LINES} lines", "a MetaImage header, which it ends")


def _numbers(path: str, fields: dict[str, str], name: str, n: int, otherwise: tuple | None = None) -> list[float]:
    text = fields.get(name.lower())
    if text is None and otherwise is not None:
        return list(otherwise)
    try:
        found = [float(word) for word in (text or "").split()]
    except ValueError:
        found = []
    if len(found) != n or not np.isfinite(found).all():
        raise InvalidScan(f"{path}:{name}", repr(text) if text is not None else "missing", f"{n} numbers")
    return found


def _yes(fields: dict[str, str], name: str, otherwise: bool = False) -> bool:
    return fields.get(name, str(otherwise)).strip().lower() in ("true", "1", "yes")


def _data_files(path: str, fields: dict[str, str]) -> tuple[str, ...]:
    """The files beside the header, none where the voxels stand after it."""
    named = fields["elementdatafile"]
    words = named.split()
    if named.upper() == "LOCAL":
        return ()
    names = fields["listed"].splitlines() if "listed" in fields else [named]
    if len(words) in (3, 4) and "%" in words[0]:
        names = numbered_files(f"{path}:ElementDataFile", *(*words, "1")[:4])
    files = tuple(os.path.join(os.path.dirname(path), name) for name in names)
    for file in files:
        if not Path(file).is_file():
            raise InvalidScan(f"{path}:ElementDataFile", f"{file} is not there", "the data file beside its header")
    if not files:
        raise InvalidScan(f"{path}:ElementDataFile", "a list of no files", "a file for each slice")
    return files


def _frame(path: str, fields: dict[str, str], n: int) -> tuple:
    notes: list[str] = []
    spacing = _numbers(path, fields, "ElementSpacing", n, tuple(_numbers(path, fields, "ElementSize", n, (0.0,) * n)))
    if not any(spacing):
        notes.append(
            "the header says no spacing: every voxel is taken as a cube of side 1; give --spacing I,J,K where it is not"
        )
        spacing = [1.0] * n
    turn = next(
        (name for name in ("TransformMatrix", "Rotation", "Orientation") if name.lower() in fields), "TransformMatrix"
    )
    axes = np.array(_numbers(path, fields, turn, n * n, tuple(np.eye(n).ravel()))).reshape(n, n)[:3, :3]
    place = next((name for name in ("Offset", "Position", "Origin") if name.lower() in fields), "Offset")
    origin = _numbers(path, fields, place, n, (0.0,) * n)[:3]
    centre = _numbers(path, fields, "CenterOfRotation", n, (0.0,) * n)[:3]
    if any(centre):
        notes.append(f"CenterOfRotation {centre} is not used, as ITK does not use it")
    return tuple(map(tuple, (axes.T * spacing[:3]).tolist())), tuple(origin), tuple(notes)
