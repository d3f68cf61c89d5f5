"""What a group's chunks have, as bytes: each byte of a row has a set of models of its own, the highest byte of a number
comes first. The two lower bytes of floats are as good as random and have no models."""

from __future__ import annotations

import numpy as np

from storage.packed.archive.coder import compiled, even, tree
from storage.packed.schema import Array, Header, arrays_of

DERIVED = "batch_count", "sizes"  # what the splats tell
_MODELLED = 2  # upper bytes of a float


def tables_in(header: Header) -> list[Array]:
    """The arrays of chunks that are kept as bytes, in the order of the page."""
    return [a for a in arrays_of(header) if a.dims[0] == "c" and a.name not in DERIVED]


def columns_of(header: Header) -> np.ndarray:
    """Whether each byte of a chunk has models, (w,) int64."""
    flags = []
    for array in tables_in(header):
        n_bytes, n = np.dtype(array.dtype).itemsize, int(array.dims[1]) if len(array.dims) > 1 else 1
        modelled = _MODELLED if array.dtype == "float32" else n_bytes
        flags += ([1] * modelled + [0] * (n_bytes - modelled)) * n
    return np.array(flags, np.int64)


def bytes_of(header: Header, arrays: dict[str, np.ndarray]) -> np.ndarray:
    """The bytes (c, w) int64 of a group's chunks."""
    parts = []
    for array in tables_in(header):
        values = np.ascontiguousarray(arrays[array.name], np.dtype(array.dtype).newbyteorder(">"))
        parts.append(values.view(np.uint8).reshape(header.n_chunks, -1))
    return np.concatenate(parts, axis=1).astype(np.int64)


def of_bytes(header: Header, rows: np.ndarray) -> dict[str, np.ndarray]:
    """The way back of `bytes_of`."""
    arrays, at = {}, 0
    for array in tables_in(header):
        shape = (header.n_chunks, *(int(dim) for dim in array.dims[1:]))
        width = int(np.prod(shape[1:])) * np.dtype(array.dtype).itemsize
        values = np.ascontiguousarray(rows[:, at : at + width], np.uint8).view(np.dtype(array.dtype).newbyteorder(">"))
        arrays[array.name] = values.reshape(shape).astype(array.dtype)
        at += width
    return arrays


@compiled
def code_tables(state, data, models, base, modelled, rows):
    """Writes or reads the bytes `rows` (c, w) int64; models of a byte begin at base + 256 times its place."""
    for chunk in range(len(rows)):
        for column in range(len(modelled)):
            if modelled[column]:
                rows[chunk, column] = tree(state, data, models, base + (column << 8), 8, rows[chunk, column])
            else:
                rows[chunk, column] = even(state, data, 8, rows[chunk, column])
