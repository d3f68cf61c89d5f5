"""PTX, Leica's text of organised scans: blocks of columns x rows points, each with the pose of its scanner.

A block begins with its number of columns and of rows, the scanner's position, its three axes, and a matrix whose rows
multiply points from the right. A point `0 0 0` is one that was not hit.

References: Leica Geosystems, "Cyclone PTX file format"; PCL and CloudCompare read it so.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice

import numpy as np

from pipeline.readers.attributes.decisions import Decision
from pipeline.readers.attributes.looks import Look, Looks
from pipeline.readers.attributes.marks import set_marks
from pipeline.readers.attributes.named import Named
from pipeline.readers.attributes.names import columns_of
from pipeline.readers.attributes.options import ReadOptions
from pipeline.readers.ply.rows import parse_rows
from pipeline.readers.text.lines import numbered_lines
from pipeline.scan import Piece, ScanSource
from storage.errors import InvalidScan

LEAST_LINE_BYTES = 8  # "0 0 0 0" and its end
FIRST_POINTS = 1 << 14  # of each block that are looked at
MOST_BLOCKS = 10_000

_NAMES = {4: ("x", "y", "z", "intensity"), 7: ("x", "y", "z", "intensity", "red", "green", "blue")}


@dataclass(frozen=True)
class _Block:
    n_points: int
    n_columns: int
    rotation: tuple[tuple[float, float, float], ...]
    translation: tuple[float, float, float]


@dataclass(frozen=True)
class _Opened:
    path: str
    options: ReadOptions
    blocks: tuple[_Block, ...]
    look: Look
    warnings: tuple[str, ...] = ()

    @property
    def n_points(self) -> int:
        return sum(b.n_points for b in self.blocks)

    @property
    def has_color(self) -> bool:
        return all(b.n_columns == 7 for b in self.blocks)

    @property
    def named(self) -> Named:
        return Named(columns_of(_NAMES[7 if self.has_color else 4]), "i4")

    @property
    def decision(self) -> Decision:
        return self.named.decide(self.look)


def _header(lines: Iterator[tuple[int, str]], path: str, n_bytes: int) -> tuple[int, np.ndarray] | None:
    """Points of the next block, and its matrix (4, 4); None at the end of the file."""
    first = next(lines, None)
    if first is None:
        return None
    number, text = first
    second = next(lines, (number + 1, ""))[1].strip()
    if not (text.strip().isdigit() and second.isdigit()):
        raise InvalidScan(f"{path}:line {number}", f"{text.strip()[:40]!r}, {second[:40]!r}", "columns and rows")
    n_points = int(text) * int(second)
    if n_points * LEAST_LINE_BYTES > n_bytes:
        raise InvalidScan(f"{path}:line {number}", f"{n_points} points in a file of {n_bytes} bytes", "a whole file")
    parse_rows(list(islice(lines, 4)), 3, path)  # the position and axes: the matrix says the same
    rows = list(islice(lines, 4))
    if len(rows) < 4:
        raise InvalidScan(f"{path}:line {number}", "the file ends within a header", "a whole file")
    matrix = parse_rows(rows, 4, path)
    if not np.isfinite(matrix).all():
        raise InvalidScan(f"{path}:line {rows[0][0]}", "a matrix with numbers that are not finite", "finite numbers")
    return n_points, matrix


def _values(lines: Iterator[tuple[int, str]], n: int, n_columns: int, path: str) -> np.ndarray:
    block = list(islice(lines, n))
    if len(block) < n:
        raise InvalidScan(path, f"the data ends {n - len(block)} points early", "a whole file", "it may be truncated")
    return parse_rows(block, n_columns, path)


def _rows(block: _Block, values: np.ndarray, with_color: bool) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Points by column, where the scanner's pose puts them, and which of them were not hit."""
    local = values[:, :3]
    nothing = (local == 0).all(axis=1)
    position = local @ np.array(block.rotation) + block.translation
    rows = dict(zip(_NAMES[block.n_columns], [*position.T, *values[:, 3:].T], strict=True))
    return {name: rows[name] for name in _NAMES[7 if with_color else 4]}, {"range-zero": nothing}


def _doubts(path: str, i: int, n_points: int, matrix: np.ndarray) -> list[str]:
    """What is odd about block `i`: no points, or a matrix that is no turn."""
    if not n_points:
        return [f"{path}: block {i + 1} has no points and is left out"]
    scales = np.linalg.norm(matrix[:3, :3], axis=1)
    if np.abs(scales - 1).max() <= 1e-3:
        return []
    return [
        f"{path}: the matrix of block {i + 1} scales points by {', '.join(f'{s:.4g}' for s in scales)}, and they are so scaled"
    ]


def open_ptx(path: str, options: ReadOptions = ReadOptions()) -> ScanSource:
    """A PTX file: all its blocks one after the other. Raises: InvalidScan naming line and column."""
    n_bytes, blocks, firsts, n_empty = os.path.getsize(path), [], [], 0  # type: ignore[var-annotated]
    warnings: list[str] = []
    with open(path, "rb") as stream:
        lines = numbered_lines(stream)
        while (head := _header(lines, path, n_bytes)) is not None:
            n_points, matrix = head
            first = next(lines, None) if n_points else (0, "0 0 0 0")
            n_columns = len(first[1].split()) if first else 0
            if n_columns not in _NAMES:
                where = f"{path}:line {first[0]}" if first else path
                raise InvalidScan(where, f"{n_columns} values", "x y z intensity, or those and red green blue")
            if len(blocks) == MOST_BLOCKS:
                raise InvalidScan(path, f"more than {MOST_BLOCKS} blocks", "fewer")
            rotation = tuple(tuple(map(float, row[:3])) for row in matrix[:3])
            block = _Block(n_points, n_columns, rotation, tuple(map(float, matrix[3, :3])))  # type: ignore[arg-type]
            n_first = min(n_points, FIRST_POINTS)
            rest = list(islice(lines, max(0, n_first - 1)))
            warnings += _doubts(path, len(blocks) + n_empty, n_points, matrix)
            n_empty += n_points == 0
            if n_points:
                firsts.append((block, parse_rows([first, *rest], n_columns, path)))
                blocks.append(block)
            for _ in islice(lines, n_points - n_first):
                pass
    opened = _Opened(path, options, tuple(blocks), Look(), tuple(warnings) if blocks else ())
    for block, values in firsts:
        opened.named.look_at(opened.look, *_rows(block, values, opened.has_color))
    return _source(opened)


def _pieces(opened: _Opened, max_points: int) -> Iterator[Piece]:
    n_bytes, is_sample = os.path.getsize(opened.path), opened.look.n_points < opened.n_points
    with open(opened.path, "rb") as stream:
        lines = numbered_lines(stream)
        for i, block in enumerate(opened.blocks):
            while (head := _header(lines, opened.path, n_bytes)) is not None and head[0] == 0:
                pass  # a block without points
            for at in range(0, block.n_points, max_points):
                n = min(max_points, block.n_points - at)
                values = _values(lines, n, block.n_columns, opened.path)
                rows, masks = _rows(block, values, opened.has_color)
                look = opened.look.like() if is_sample else None
                if look is not None:
                    opened.named.look_at(look, rows, masks)
                yield replace(
                    opened.named.piece(rows, opened.decision),
                    station=np.full(n, i, np.int32),
                    mark=set_marks(n, masks, opened.options.left_out),
                    look=None if look is None else (0, look),
                )


def _source(opened: _Opened) -> ScanSource:
    decision, warnings = opened.decision, list(opened.warnings)
    bare = sum(b.n_columns == 4 for b in opened.blocks)
    if 0 < bare < len(opened.blocks):
        warnings.append(f"{opened.path}: {bare} of {len(opened.blocks)} blocks have no colours; none are used")
    return ScanSource(
        path=opened.path,
        format="ptx",
        n_points=opened.n_points,
        pieces=partial(_pieces, opened),
        settle=partial(_settled, opened) if opened.look.n_points < opened.n_points else None,
        unit="metre",
        stations=tuple(b.translation for b in opened.blocks),
        has_colors=decision.top is not None,
        has_intensity=decision.intensity,
        warnings=(*warnings, *opened.named.reasons(opened.path, opened.look, decision, opened.n_points)),
        details={"blocks": [b.n_points for b in opened.blocks]},
    )


def _settled(opened: _Opened, looks: Looks) -> ScanSource | None:
    as_all = replace(opened, look=looks.parts[0])
    return None if as_all.decision == opened.decision else _source(as_all)
