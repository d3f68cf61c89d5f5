"""Fields of LAS records: which hold what, and several beside each other by one pass."""

from __future__ import annotations

import numpy as np

from pipeline.execution.compiled import kernel
from pipeline.readers.attributes.names import columns_of
from pipeline.readers.las.header import RECORD_SIZES, LasHeader, extra_fields

RGB_AT = {2: 20, 3: 28, 5: 28, 7: 30, 8: 30, 10: 30}


@kernel()
def placed(x, y, z, scales, offsets):
    """Positions (n, 3) float64 of whole steps `x`, `y`, `z` (n,) int32: steps * scale + offset, rounded twice."""
    position = np.empty((len(x), 3))
    for i in range(len(x)):
        position[i, 0] = x[i] * scales[0] + offsets[0]
        position[i, 1] = y[i] * scales[1] + offsets[1]
        position[i, 2] = z[i] * scales[2] + offsets[2]
    return position


@kernel()
def beside(a, b, c):
    """Three fields (n,) of one type as (n, 3)."""
    rows = np.empty((len(a), 3), a.dtype)
    for i in range(len(a)):
        rows[i, 0], rows[i, 1], rows[i, 2] = a[i], b[i], c[i]
    return rows


def layout_of(header: LasHeader) -> np.dtype:
    """The fields of a record that are read, by name."""
    new = header.point_format >= 6
    fields = {"X": ("<i4", 0), "Y": ("<i4", 4), "Z": ("<i4", 8), "intensity": ("<u2", 12), "flags": ("u1", 15)}
    fields["class"] = ("u1", 16 if new else 15)
    fields["source id"] = ("<u2", 20 if new else 18)
    if at := RGB_AT.get(header.point_format):
        fields |= {name: ("<u2", at + 2 * i) for i, name in enumerate(("red", "green", "blue"))}
    first = RECORD_SIZES[header.point_format]
    fields |= {f"extra {f.name}": (f"<{f.dtype}", first + f.at) for f in extra_fields(header)}
    names, values = list(fields), list(fields.values())
    kinds, at = [v[0] for v in values], [v[1] for v in values]  # type: ignore[assignment]
    return np.dtype({"names": names, "formats": kinds, "offsets": at, "itemsize": header.record_size})  # type: ignore[call-overload]


def color_fields(header: LasHeader) -> tuple[str, ...]:
    """The fields of a record that hold colours: the standard's, else whole numbers in extra bytes of such names."""
    if header.point_format in RGB_AT:
        return ("red", "green", "blue")
    extra = {f.name: f for f in extra_fields(header)}
    names = columns_of(extra).color
    is_whole = all(extra[n].dtype in ("u1", "u2") and (extra[n].scale, extra[n].offset) == (1, 0) for n in names)
    return tuple(f"extra {n}" for n in names) if is_whole and len({extra[n].dtype for n in names}) == 1 else ()


def colors_of(rows: np.ndarray, fields: tuple[str, ...]) -> np.ndarray | None:
    """Colours (n, 3) uint8 or uint16 as they stand in `fields`; None where there are none."""
    return beside(*(rows[c] for c in fields)) if fields else None


def normals_of(rows: np.ndarray, header: LasHeader, names: tuple[str, ...]) -> np.ndarray | None:
    """Normals (n, 3) float32 from the extra bytes of these names; None where there are none."""
    if not names:
        return None
    fields = {f.name: f for f in extra_fields(header)}
    columns = [rows[f"extra {n}"] * fields[n].scale + fields[n].offset for n in names]
    return np.stack(columns, axis=1).astype(np.float32)
