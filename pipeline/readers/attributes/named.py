"""Points as columns of numbers with names: what of them is a position, a colour, and how it is drawn. For every format but E57's."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from pipeline.readers.attributes.decisions import Decision, decide, reasons
from pipeline.readers.attributes.looks import Look
from pipeline.readers.attributes.marks import set_marks
from pipeline.readers.attributes.names import HARMONIC, Columns
from pipeline.readers.attributes.ranges import to_8_bits
from pipeline.scan import Piece

Rows = dict[str, np.ndarray]  # by the name of a column, (n,) each
NOWHERE = "range-zero"
LEAST_NOWHERE = 0.01  # of the points that were looked at: a scan that goes through its origin has one point there


def is_nowhere(blocks: Iterable[Rows], columns: Columns) -> bool:
    """Whether so many points lie at (0, 0, 0) as in a depth picture, whose pixels that were not measured do."""
    n_points = n_there = 0
    for rows in blocks:
        n_points += len(rows[columns.position[0]])
        n_there += int(np.count_nonzero(_at_origin(rows, columns)))
    return n_there >= max(2, LEAST_NOWHERE * n_points)


def _at_origin(rows: Rows, columns: Columns) -> np.ndarray:  # (n,) bool
    x, y, z = (rows[name] for name in columns.position)
    there = x == 0
    return there & (y == 0) & (z == 0) if there.any() else there


@dataclass(frozen=True)
class Named:
    """How the columns of a file are used: what they mean, and of what type its colours are."""

    columns: Columns
    color_type: str = "f8"  # numpy code
    origin_is_nowhere: bool = False  # points at (0, 0, 0) were not measured
    left_out: frozenset[str] = frozenset()  # marks, as ReadOptions has them

    @property
    def _attributes(self) -> tuple[bool, bool, float, bool]:
        """Whether there are colours, as floats, what is white in their type, and whether there are intensities."""
        is_float = self.color_type.startswith("f")
        usual = 1.0 if is_float else 65535.0 if self.color_type == "u2" else 255.0
        return bool(self.columns.color), is_float, usual, bool(self.columns.intensity)

    def decide(self, look: Look) -> Decision:
        return decide(look, *self._attributes)

    def reasons(self, where: str, look: Look, decision: Decision, n_points: int) -> list[str]:
        return reasons(where, look, decision, *self._attributes, n_points)

    def has_colors(self, decision: Decision) -> bool:
        return decision.top is not None or bool(self.columns.harmonic)

    def look_at(self, look: Look, rows: Rows, masks: dict[str, np.ndarray] | None = None) -> None:
        """At what was measured: marked points tell nothing of others' colours."""
        self._look_at(look, rows, self._color(rows), self._masks(rows) if masks is None else masks)

    def _masks(self, rows: Rows) -> dict[str, np.ndarray]:
        return {NOWHERE: _at_origin(rows, self.columns)} if self.origin_is_nowhere else {}

    def _look_at(self, look: Look, rows: Rows, color: np.ndarray | None, masks: dict[str, np.ndarray]) -> None:
        intensity = _native(rows[self.columns.intensity[0]]) if self.columns.intensity else None
        if masks:
            left = ~np.any(list(masks.values()), axis=0)
            color, intensity = (None if v is None else v[left] for v in (color, intensity))
        look.add(len(rows[self.columns.position[0]]), color, intensity, masks)

    def piece(self, rows: Rows, decision: Decision, look: Look | None = None) -> Piece:
        """The points of rows, marked only where they lie at an origin that is nowhere; `look` looks at them too."""
        columns, masks = self.columns, self._masks(rows)
        values = self._color(rows) if decision.top is not None or look is not None else None
        if look is not None:
            self._look_at(look, rows, values, masks)

        def stack(names: tuple[str, ...], dtype: type) -> np.ndarray | None:
            return _side_by_side(rows, names, np.dtype(dtype)) if names else None

        color, colorless = None, None
        if decision.top is not None:
            color = to_8_bits(values, decision.top)
            colorless = ~np.isfinite(values).all(axis=1) if values.dtype.kind == "f" else None
        elif columns.harmonic:
            color = to_8_bits(0.5 + HARMONIC * stack(columns.harmonic, np.float64), 1.0)
        return Piece(
            position=stack(columns.position, np.float64),
            normal=stack(columns.normal, np.float32),
            color=color,
            colorless=colorless,
            intensity=rows[columns.intensity[0]].astype(np.float32) if decision.intensity else None,
            mark=set_marks(len(rows[columns.position[0]]), masks, self.left_out) if masks else None,
        )

    def _color(self, rows: Rows) -> np.ndarray | None:  # (n, 3)
        names = self.columns.color
        if not names:
            return None
        color = _native(np.stack([rows[n] for n in names], axis=1))
        return color.astype(np.uint8) if self.color_type == "i1" else color  # `char` of a writer that means `uchar`


def _side_by_side(rows: Rows, names: tuple[str, ...], dtype: np.dtype) -> np.ndarray:  # (n, k)
    made = np.empty((len(rows[names[0]]), len(names)), dtype)
    for column, name in enumerate(names):
        made[:, column] = rows[name]
    return made


def _native(values: np.ndarray) -> np.ndarray:
    return values.astype(values.dtype.newbyteorder("="), copy=False)
