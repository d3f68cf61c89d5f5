"""A group of a packed file in few bytes, and back, as arrays of a file's plain form.

Guarantees of `pack_group` and `unpack_group`: the same arrays bit by bit, but that of boxes the splats of a batch of a
chunk stand in the order of the tree; so what is packed again is the same bytes. No more bytes than the arrays take as
they stand, and one more.
"""

from __future__ import annotations

import math

import numpy as np

from storage.packed.archive.coder import READING, WRITING, begin, compiled, end, within
from storage.packed.archive.columns import (
    Splats,
    arrays_of_splats,
    axis_of_heights,
    check_chunks,
    chunks_of,
    form_of,
    kinds_of,
    splats_of,
)
from storage.packed.archive.continued import Looks
from storage.packed.archive.mixing import N_BASES, SIGNED_SETS, Models, fresh_models, mixed_tree
from storage.packed.archive.splats import N_FIELDS, N_SETS, SIZES, code_splats, models_of
from storage.packed.archive.squares import squares_of
from storage.packed.archive.tables import MODELS_A_COLUMN, code_tables, columns_of, numbers_of, of_numbers
from storage.packed.scene import PackedScene
from storage.packed.schema import BOXES, Header, arrays_of, dimensions_of

CODED, AS_THEY_STAND = 0, 1  # the first byte of a group
_AXIS_MODELS = 4  # of the axis of heights
_ROOM, _ROOM_A_SPLAT = 1 << 16, 1024  # bytes that no group takes: a bit by a model takes at most 12


_AXIS_SET = N_SETS
_TABLE_SETS = N_SETS + 4


def group_models(header: Header, priors: np.ndarray | None = None) -> Models:
    """The models as every group begins with them, with what a file knows of them (`Models.known`)."""
    n_columns = len(columns_of(header))
    n = int(models_of(form_of(header))[-1]) + _AXIS_MODELS + MODELS_A_COLUMN * n_columns
    models = fresh_models(n, _TABLE_SETS + SIGNED_SETS * n_columns)
    return models if priors is None else models.begun(priors)


@compiled
def _code_axes(state, data, models, weights, base, axis):
    bases = np.full(N_BASES, base)
    for chunk in range(len(axis)):
        found = mixed_tree(state, data, models, weights, bases, 1, _AXIS_SET, 2, axis[chunk])
        axis[chunk] = within(state, found, 3)


def code_group(scene: PackedScene, models: Models, looks: Looks) -> np.ndarray:
    """The bytes (m,) uint8 of a group's splats and chunks; the models learn from it."""
    header, at = scene.header, models_of(form_of(scene.header))
    out = np.empty(_ROOM + _ROOM_A_SPLAT * header.n_splats, np.uint8)
    state = begin(WRITING, out)
    tables, axis = numbers_of(header, scene.arrays), np.zeros(header.n_chunks, np.int64)
    code_tables(state, out, *models.pair, at[-1] + _AXIS_MODELS, _TABLE_SETS, columns_of(header), tables)
    if header.geometry == BOXES:
        axis = axis_of_heights(scene)
        _code_axes(state, out, *models.pair, at[-1], axis)
    chunks, steps = chunks_of(header, scene.arrays, axis)
    s, form = splats_of(scene, chunks), form_of(header)
    order = np.arange(header.n_splats)
    code_splats(
        state, out, *models.pair, at, form, chunks, steps, kinds_of(header), looks.arrays,
        squares_of(header, scene.arrays, axis, chunks[:, SIZES]).arrays, s.fields, s.first, s.entries, order,
    )  # fmt: skip
    return out[: end(state, out)].copy()


def _read_group(header: Header, data: np.ndarray, models: Models, looks: Looks) -> dict[str, np.ndarray]:
    """The way back of `code_group`, with the models as they were."""
    at, n = models_of(form_of(header)), header.n_splats
    state, columns = begin(READING, data), columns_of(header)
    rows, axis = np.zeros((header.n_chunks, len(columns) + 1), np.int64), np.zeros(header.n_chunks, np.int64)
    code_tables(state, data, *models.pair, at[-1] + _AXIS_MODELS, _TABLE_SETS, columns, rows)
    tables = of_numbers(header, rows)
    if header.geometry == BOXES:
        _code_axes(state, data, *models.pair, at[-1], axis)
    check_chunks(header, tables)
    chunks, steps = chunks_of(header, tables, axis)
    fields, first, form = np.zeros((n, N_FIELDS), np.int64), np.zeros(n, np.int64), form_of(header)
    entries, order = np.zeros((n * header.n_ranks, 2), np.int64), np.arange(n)
    code_splats(
        state, data, *models.pair, at, form, chunks, steps, kinds_of(header), looks.arrays,
        squares_of(header, tables, axis, chunks[:, SIZES]).arrays, fields, first, entries, order,
    )  # fmt: skip
    if not end(state, data):
        raise ValueError(f"{len(data)} bytes of a group that are not those of its {n} splats")
    return arrays_of_splats(header, tables, chunks, Splats(fields, first, entries))


def pack_group(
    scene: PackedScene, arrays: dict[str, np.ndarray], priors: np.ndarray | None, looks: Looks
) -> np.ndarray:
    """The bytes (m,) uint8 of a group: `scene` is it alone, `arrays` are its rows that count."""
    coded = code_group(scene, group_models(scene.header, priors), looks)
    stood = _as_they_stand(scene.header, arrays)
    kind, data = (CODED, coded) if len(coded) <= len(stood) else (AS_THEY_STAND, stood)
    return np.concatenate([np.array([kind], np.uint8), data])


def unpack_group(
    header: Header, data: np.ndarray, n_rows: dict[str, int], priors: np.ndarray | None, looks: Looks
) -> dict[str, np.ndarray]:
    """The arrays of a group of bytes (m,) uint8, the rows that count; `header` is the group's alone, of the plain form,
    `n_rows` are what the table says of arrays with any number of rows.

    Raises: ValueError where bytes are not just those of such a group. Any bytes may come: none beyond them are read.
    """
    if not len(data) or data[0] not in (CODED, AS_THEY_STAND):
        raise ValueError(f"a group that begins with {data[:1].tolist()}, not {CODED} or {AS_THEY_STAND}")
    if data[0] == AS_THEY_STAND:
        return _stood(header, data[1:], n_rows)
    return _read_group(header, np.array(data[1:]), group_models(header, priors), looks)


def _as_they_stand(header: Header, arrays: dict[str, np.ndarray]) -> np.ndarray:
    parts = [arrays[a.name].astype(np.dtype(a.dtype).newbyteorder("<")) for a in arrays_of(header) if a.in_groups]
    return np.concatenate([np.frombuffer(part.tobytes(), np.uint8) for part in parts])


def _stood(header: Header, data: np.ndarray, n_rows: dict[str, int]) -> dict[str, np.ndarray]:
    """The way back of `_as_they_stand`."""
    arrays, at, sizes = {}, 0, dimensions_of(header)
    for array in (a for a in arrays_of(header) if a.in_groups):
        shape = (n_rows[array.name],) if array.is_ragged else tuple(sizes[dim] for dim in array.dims)
        dtype = np.dtype(array.dtype).newbyteorder("<")
        end_ = at + math.prod(shape) * dtype.itemsize
        if end_ > len(data):
            break
        arrays[array.name] = np.frombuffer(data[at:end_].tobytes(), dtype).reshape(shape).astype(array.dtype)
        at = end_
    else:
        if at == len(data):
            return arrays
    raise ValueError(f"{len(data)} bytes of a group as it stands that are not those of its {header.n_splats} splats")
