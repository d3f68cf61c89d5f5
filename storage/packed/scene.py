"""A packed file in memory, whole or one group of it, and the checks of its tables against each other."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from storage.maps import IN_PART, NO_MAP
from storage.packed.batches import Rows, group_batch_counts, rows_of
from storage.packed.bits import unpack_sizes, words_for
from storage.packed.codes import unpack_codes
from storage.packed.colors import color_words, unpack_colors
from storage.packed.quadrics import check_numbers, frame_sizes, unpack_numbers
from storage.packed.runs.tables import DECODED, check_runs
from storage.packed.schema import (
    BY_NAME,
    CHUNK,
    ELLIPSOID_FIELDS,
    EXTRAS,
    GROUP,
    MOST_COLOR_BITS,
    NO_CAMERA,
    QUADRICS,
    Header,
    color_bits,
)

POSITION_BITS = 24


@dataclass(frozen=True)
class PackedScene:
    """A packed file in memory: its header and, by the names of the schema, its arrays.

    `decoded` keeps what readers worked out from them, so that it is worked out once (pipeline/splats/decoded.py)."""

    header: Header
    arrays: dict[str, np.ndarray]
    decoded: dict[str, Any] = field(default_factory=dict, compare=False, repr=False)

    @cached_property
    def rows(self) -> Rows:
        return rows_of(self.arrays["batch_count"], self.header.batches)

    @cached_property
    def n_atoms(self) -> np.ndarray:  # (n,) int64
        return np.array([batch.n_atoms for batch in self.header.batches])[self.rows.batch]

    @property
    def ellipsoids(self) -> tuple[np.ndarray, np.ndarray]:
        """Which splats are ellipsoids (m,), and their fields (m, ELLIPSOID_FIELDS) uint8."""
        row = self.rows.extra["ellipsoid"]
        splat = np.flatnonzero(row >= 0)
        if not len(splat):
            return splat, np.zeros((0, ELLIPSOID_FIELDS), np.uint8)
        word = self.arrays["ellipsoids"][self.arrays["ellipsoid_word"][splat // GROUP].astype(np.int64) + row[splat]]
        return splat, word.astype("<u4").view(np.uint8).reshape(len(splat), ELLIPSOID_FIELDS)

    def codes(self, start: int = 0, stop: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Atoms and weight codes of the splats start..stop, two (n, n_ranks) int32, zero beyond their n_atoms."""
        n_atoms = self.n_atoms[start:stop]
        if not self.header.n_dictionary:
            shape = (len(n_atoms), self.header.n_ranks)
            return np.zeros(shape, np.int32), np.zeros(shape, np.int32)
        group = np.arange(self.header.n_splats)[start:stop] // GROUP
        return unpack_codes(
            self.header, self.arrays["codes"], self.arrays["group_word"][group], self.rows.entry[start:stop], n_atoms
        )

    @cached_property
    def color_cells(self) -> np.ndarray:
        """Of each splat, (n,) uint32, where the file has boxes of colours."""
        bits = color_bits(self.arrays["color_size"], self.header.color_step).sum(axis=1)
        return unpack_colors(self.arrays["colors"], self.arrays["color_word"], bits, self.header.n_splats)

    @cached_property
    def numbers(self) -> np.ndarray:
        """Of each splat, (n,) uint64, where the geometry is quadrics."""
        return unpack_numbers(self.arrays["splats"], self.arrays["batch_count"], self.arrays["frame_bits"])

    @cached_property
    def size_codes(self) -> np.ndarray:
        """Of each splat, (n,) uint8, where each has a size of its own."""
        if self.header.geometry == QUADRICS:
            cells = frame_sizes(self.arrays)[np.arange(self.header.n_splats) // CHUNK]
            return (self.numbers % cells).astype(np.uint8)
        return unpack_sizes(self.arrays["sizes"], self.header.size_bits, self.header.n_splats)


@dataclass(frozen=True)
class Stream:
    """A word stream: its array, the table of its groups' first words, and what each splat puts in."""

    name: str
    table: str
    width: int  # bits of a field
    fields: np.ndarray  # (n_batches,) of a splat of each batch

    def words(self, counts: np.ndarray) -> np.ndarray:
        """Words of each group, (n_groups,) int64, of `counts` (n_groups, n_batches) from `group_batch_counts`."""
        return np.array([words_for(int(n), self.width) for n in counts @ self.fields], np.int64)


def streams_of(header: Header) -> list[Stream]:
    """The word streams that a file has."""
    streams = []
    if header.n_dictionary:
        fields = np.array([batch.n_atoms for batch in header.batches])
        streams.append(Stream("codes", "group_word", header.entry_bits, fields))
    for extra in EXTRAS:
        fields = np.array([extra.n_fields * getattr(batch, extra.flag) for batch in header.batches])
        if fields.any():
            streams.append(Stream(extra.stream, extra.table, extra.bits, fields))
    return streams


def check_tables(scene: PackedScene) -> None:
    """ValueError unless every table, index and number of a scene is in its range, so that no decoder needs to ask."""
    header, arrays = scene.header, scene.arrays
    sizes = np.minimum(CHUNK, header.n_splats - CHUNK * np.arange(header.n_chunks))
    if not (arrays["batch_count"].sum(axis=1, dtype=np.int64) == sizes).all():
        raise ValueError("batch_count does not add up to the size of every chunk")
    if header.runs:
        check_runs(header, arrays)
    elif header.geometry == QUADRICS:
        check_numbers(arrays)
    elif not (arrays["box_bits"].sum(axis=1, dtype=np.int64) == POSITION_BITS).all():
        raise ValueError(f"box_bits does not add up to {POSITION_BITS} in every chunk")
    _check_numbers(arrays)
    if header.size_bits and (arrays["size_scale"][:, 0] > arrays["size_scale"][:, 1]).any():
        raise ValueError("size_scale has a smallest size above the largest")
    if header.color_step:
        _check_colors(header, arrays)
    counts = group_batch_counts(arrays["batch_count"])
    for stream in streams_of(header):
        n_words = stream.words(counts)
        starts = np.cumsum(n_words) - n_words
        if len(arrays[stream.name]) != n_words.sum() + 1 or not (arrays[stream.table] == starts).all():
            raise ValueError(f"{stream.table} and {stream.name} do not fit batch_count")
    for start in range(0, header.n_splats, GROUP):  # the codes of the whole scene would not fit beside it
        if scene.codes(start, start + GROUP)[0].max() >= max(1, header.n_indices):
            raise ValueError(f"an atom index beyond the dictionary's {header.n_indices}")
    if header.maps and ((arrays["station"] % IN_PART >= len(header.maps)) & (arrays["station"] != NO_MAP)).any():
        raise ValueError(f"a station beyond the {len(header.maps)} maps")
    if header.cameras:
        camera = arrays["camera"]
        if ((camera >= len(header.cameras)) & (camera != NO_CAMERA)).any():
            raise ValueError(f"a camera index beyond the {len(header.cameras)} cameras")


def _check_colors(header: Header, arrays: dict[str, np.ndarray]) -> None:
    bits = color_bits(arrays["color_size"], header.color_step).sum(axis=1)
    if bits.max() > MOST_COLOR_BITS:
        raise ValueError(f"colours of {bits.max()} bits a splat, more than {MOST_COLOR_BITS}")
    n_words = color_words(header.n_splats, bits)
    if len(arrays["colors"]) != n_words.sum() + 1 or not (arrays["color_word"] == np.cumsum(n_words) - n_words).all():
        raise ValueError("color_word and colors do not fit color_size")


def _check_numbers(arrays: dict[str, np.ndarray]) -> None:
    dtypes = {array.name: array.dtype for array in (*BY_NAME.values(), *DECODED)}
    for name, values in arrays.items():
        kind = dtypes.get(name, "uint32")  # first words, which no file holds
        if kind == "float32" and not np.isfinite(values).all():
            raise ValueError(f"{name} is not finite")
        if kind == "int8" and values.min() < -127:
            raise ValueError(f"{name} has -128, which GPUs read as -127")
    if "box_size" in arrays and arrays["box_size"].min() < 0:
        raise ValueError(f"box_size has {arrays['box_size'].min()}, less than 0")
