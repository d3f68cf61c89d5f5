"""What there is to know of a packed file as a whole, from its table and its counts alone."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from storage.packed.groups import TABLE, ragged_in
from storage.packed.layout import bytes_on_gpu, shape_of
from storage.packed.runs.tables import DECODED
from storage.packed.schema import BY_NAME, EXTRAS, QUADRICS, Header, arrays_of, atom_arrays


@dataclass(frozen=True)
class Totals:
    """Of a packed file."""

    header: Header
    bytes: dict[str, int]  # of each array as the GPU takes it
    splats: np.ndarray  # (n_batches,) int64


def array_bytes(header: Header, rows: list[int]) -> dict[str, int]:
    """Bytes of each array as the GPU takes them: of streams the words that count, and a spare one; also of atoms that
    ship with the program. `rows` are those of all groups, of each array that they have any number of rows of."""
    found, tables = {}, {"codes": "group_word"} | {extra.stream: extra.table for extra in EXTRAS}
    shipped = [BY_NAME[name] for name in atom_arrays(header)] if header.shipped else []
    for array in (*arrays_of(header), *shipped):
        if array.name not in TABLE and not array.is_ragged:
            n_bytes = int(np.prod(shape_of(header, array))) * np.dtype(array.dtype).itemsize
            found[array.name] = bytes_on_gpu(header, array, n_bytes)
    if header.runs:
        counts = {
            "q": header.runs.n_sections,
            "m": header.runs.n_runs,
            "t": header.n_splats - header.runs.n_runs,
            "3": 3,
            "2": 2,
        }
        for array in DECODED:
            found[array.name] = math.prod(counts[d] for d in array.dims) * np.dtype(array.dtype).itemsize
        found["run_section"] = 4 * header.n_groups
    for i, array in enumerate(ragged_in(header)):
        if array.name == "run_codes":
            continue
        a_row = int(np.prod(shape_of(header, array)[2:])) * np.dtype(array.dtype).itemsize
        found[array.name] = a_row * (rows[i] + ("e" in array.dims))
        if array.name in tables:
            found[tables[array.name]] = 4 * header.n_groups
    found |= {"color_word": 4 * header.n_chunks} if header.color_step else {}
    return found | ({"splat_word": 20 * header.n_groups} if header.geometry == QUADRICS else {})
