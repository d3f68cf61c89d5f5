"""Points as lines of text (.xyz, .pts, .txt, .asc, .csv): what columns mean is told by a header, else by their values, and said.

A header is a line of names, as CloudCompare writes it (`//X Y Z R G B`), or of a number of points alone, as Leica's PTS has.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice

import numpy as np

from pipeline.readers.attributes.decisions import Decision
from pipeline.readers.attributes.looks import Look, Looks
from pipeline.readers.attributes.named import Named, is_nowhere
from pipeline.readers.attributes.names import columns_of
from pipeline.readers.attributes.options import ReadOptions
from pipeline.readers.ply.rows import parse_rows
from pipeline.readers.text.lines import COMMENTS, numbered_lines
from pipeline.scan import Piece, ScanSource
from storage.errors import InvalidScan, UnsupportedScan

FIRST_POINTS = 1 << 14  # that columns and ranges are told from
MOST_COLUMNS = 256
UNIT = 0.02  # how far from 1 the lengths of normals may be
_DELIMITERS = (";", ",", "\t")


@dataclass(frozen=True)
class _Opened:
    path: str
    n_points: int
    names: tuple[str, ...]
    delimiter: str | None  # None: blanks
    is_guess: bool
    named: Named
    look: Look

    @property
    def decision(self) -> Decision:
        return self.named.decide(self.look)


def _words(line: str, delimiter: str | None) -> list[str]:
    return [w for w in (w.strip() for w in line.split(delimiter)) if w]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _delimiter_of(line: str) -> str | None:
    return next((d for d in _DELIMITERS if line.count(d) >= 2), None)


def _header_names(path: str) -> tuple[str, ...]:
    """The names in the last line before the first of numbers; none where there are none."""
    with open(path, "rb") as stream:
        names: tuple[str, ...] = ()
        for _, line in islice(numbered_lines(stream, skip_comments=False), 1000):
            plain = line.replace('"', "").strip().lstrip("/#% ")
            words = [w for w in re.split(r"[\s,;]+", plain) if w]
            if words and not line.strip().startswith(COMMENTS) and all(map(_is_number, words)):
                return names
            if len(columns_of(words).position) == 3:
                names = tuple(words)
    return ()


def _rows_of(path: str, n_columns: int | None, delimiter: str | None) -> Iterator[tuple[int, str]]:
    """Lines of points: not a header, nor a number of points alone."""
    with open(path, "rb") as stream:
        begun = False
        for number, line in numbered_lines(stream):
            line = line.replace('"', "")
            words = _words(line, delimiter if n_columns else _delimiter_of(line))
            if len(words) == 1 and words[0].isdigit() and n_columns != 1:
                continue
            if not begun and not all(map(_is_number, (w.replace(",", ".") for w in words))):
                continue  # a header, however many lines it has
            begun = True
            yield number, line


def _guess(values: np.ndarray, is_pts: bool) -> list[str]:
    """What the columns (n, k) of points mean, by their values."""
    k = values.shape[1]
    names = ["number", "x", "y", "z"] if k > 3 and _are_numbers(values[:, 0]) else ["x", "y", "z"]
    at = len(names)
    while at < k:
        left = k - at
        three = values[:, at : at + 3]
        if left >= 3 and _are_normals(three):
            names += ["nx", "ny", "nz"]
        elif left >= 3 and _are_colors(three) and (left != 4 or _come_first(values[:, at:], is_pts)):
            names += ["red", "green", "blue"]
        elif "intensity" not in names:
            names.append("intensity")
        else:
            names.append(f"column {at + 1}")
        at = len(names)
    return names


def _are_numbers(column: np.ndarray) -> bool:
    """Whether it counts the points."""
    return len(column) > 1 and column[0] in (0, 1) and bool((np.diff(column) == 1).all())


def _come_first(four: np.ndarray, is_pts: bool) -> bool:
    """Whether colours come before what else there is of four columns (n, 4), and not after it, where the first three may be
    colours: an opacity is the same everywhere, and an intensity may be above 255."""
    if not _are_colors(four[:, 1:]):
        return not is_pts
    if np.ptp(four[:, 3]) == 0 < np.ptp(four[:, 0]):
        return True
    return bool(four[:, 3].max() > 255 >= four[:, :3].max() and four[:, :3].max() > 1)


def _are_normals(three: np.ndarray) -> bool:
    length = np.linalg.norm(three, axis=1)
    return bool(np.mean(np.abs(length - 1) < UNIT) > 0.9 and np.abs(three).max() <= 1 + UNIT)


def _are_colors(three: np.ndarray) -> bool:
    """Whole numbers of 16 bits, or fractions up to 1, that are not below 0."""
    whole = (three == np.rint(three)).all() and three.max() <= 65535
    return bool(np.isfinite(three).all() and three.min() >= 0 and (whole or three.max() <= 1))


def _refuse_grids(path: str) -> None:
    """Heights in rows and columns, which would be read as points of three columns and more.

    Raises: UnsupportedScan.
    """
    with open(path, "rb") as stream:
        words = stream.read(4096).lower().split()
    kind = "an ESRI ASCII grid" if words[:1] == [b"ncols"] and b"nrows" in words[:4] else ""
    kind = "a Surfer grid" if words[:1] == [b"dsaa"] else kind
    if kind:
        raise UnsupportedScan(
            path, kind, "lines of x y z and what else there is", "GDAL's gdal_translate -of XYZ makes them"
        )


def open_table(path: str, options: ReadOptions = ReadOptions()) -> ScanSource:
    """A text file of points. Raises: InvalidScan naming line and column of what is no number."""
    _refuse_grids(path)
    first = next(_rows_of(path, None, None), None)
    if first is None:
        raise InvalidScan(path, "no line of numbers", "lines of x y z and what else there is")
    delimiter = _delimiter_of(first[1])
    n_columns = len(_words(first[1], delimiter))
    if not 3 <= n_columns <= MOST_COLUMNS:
        raise InvalidScan(f"{path}:line {first[0]}", f"{n_columns} numbers", f"3 to {MOST_COLUMNS} a line")
    lines = list(islice(_rows_of(path, n_columns, delimiter), FIRST_POINTS))
    values = parse_rows(lines, n_columns, path, delimiter)
    names, is_guess = _header_names(path), False
    if len(names) != n_columns or len(set(names)) < n_columns:
        names, is_guess = tuple(_guess(values, path.lower().endswith(".pts"))), True
    columns = columns_of(names)
    whole = columns.color and (values[:, [names.index(c) for c in columns.color]] % 1 == 0).all()
    rows, look = dict(zip(names, values.T, strict=True)), Look()
    named = Named(columns, "i4" if whole else "f8", is_nowhere([rows], columns), options.left_out)
    named.look_at(look, rows)
    n_points = len(lines) if len(lines) < FIRST_POINTS else sum(1 for _ in _rows_of(path, n_columns, delimiter))
    return _source(_Opened(path, n_points, names, delimiter, is_guess, named, look))


def _pieces(opened: _Opened, max_points: int) -> Iterator[Piece]:
    lines, is_sample = (
        _rows_of(opened.path, len(opened.names), opened.delimiter),
        opened.look.n_points < opened.n_points,
    )
    while block := list(islice(lines, max_points)):
        values = parse_rows(block, len(opened.names), opened.path, opened.delimiter)
        rows = dict(zip(opened.names, values.T, strict=True))
        look = opened.look.like() if is_sample else None
        if look is not None:
            opened.named.look_at(look, rows)
        yield replace(opened.named.piece(rows, opened.decision), look=None if look is None else (0, look))


def _source(opened: _Opened) -> ScanSource:
    columns, decision = opened.named.columns, opened.decision
    warnings = opened.named.reasons(opened.path, opened.look, decision, opened.n_points)
    if opened.is_guess:
        warnings.insert(0, f"{opened.path}: no header names its columns; taken as {' '.join(opened.names)}")
    return ScanSource(
        path=opened.path,
        format="text",
        n_points=opened.n_points,
        pieces=partial(_pieces, opened),
        settle=partial(_settled, opened) if opened.look.n_points < opened.n_points else None,
        has_normals=bool(columns.normal),
        has_colors=opened.named.has_colors(decision),
        has_intensity=decision.intensity,
        warnings=tuple(warnings),
        unused=columns.unused,
        details={"columns": list(opened.names)},
    )


def _settled(opened: _Opened, looks: Looks) -> ScanSource | None:
    as_all = replace(opened, look=looks.parts[0])
    return None if as_all.decision == opened.decision else _source(as_all)
