"""Groups as units: the table of groups that a file begins with, and how long the streams of a group are.

A group's rows of every array are zarr chunks of their own, which stand together in the file; the table says where, what
they show and how long their streams are. So a reader finds out what is worth fetching, fetches it as one range, and
checks it alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np

from storage.packed.batches import group_batch_counts
from storage.packed.bits import unpack_sizes
from storage.packed.colors import color_words
from storage.packed.quadrics import check_frames, frame_boxes, frame_sizes, number_starts, unpack_numbers
from storage.packed.runs.tables import DECODED, most_bytes, run_bounds
from storage.packed.schema import (
    BOXES,
    BY_NAME,
    CHUNK,
    EXTRAS,
    GROUP,
    MOST_COLOR_BITS,
    MOST_NUMBER_BITS,
    ONE_SIZE,
    QUADRICS,
    SIZE_STEPS_AN_OCTAVE,
    Array,
    Header,
    arrays_of,
    color_bits,
    dimensions_of,
)

PREFIX = "group_"  # of the table's arrays; what follows is a field of GroupTable
CONE_STEPS = 127  # of an axis and of a cosine
ANY_NORMAL = np.array([0, 0, CONE_STEPS, -CONE_STEPS], np.int8)
_WIDER = 1e-6  # so that rounding never narrows a cone
SAME_CORNER = 1e-5  # as a share of the largest coordinate: what rotations of two machines may differ by
SAME_RADIUS = 1e-5  # as a share: what the sums of two machines may differ by


@dataclass(frozen=True)
class GroupTable:
    """The table of groups, the coarsest level's first."""

    low: np.ndarray  # (g, 3) float32: lowest corner of their boxes against the origin, unit
    high: np.ndarray  # (g, 3) float32
    cone: np.ndarray  # (g, 4) int8: axis of a cone of their normals, cosine of its half angle, both in 127ths
    radius: np.ndarray  # (g, 2) float32: mean radius by area and largest radius, unit
    rows: np.ndarray  # (g, v) uint32: of each array of `ragged_in`
    start: np.ndarray  # (g,) uint64: where their members begin in the file
    bytes: np.ndarray  # (g,) uint64
    seal: np.ndarray  # (g, 32) uint8: SHA-256 of their zarr chunks


# Tables that readers make of the lengths of streams and of runs, for memory and GPUs, and the row of the size table
# that their bytes are counted in.
FIRST_WORDS = {
    "run_section": "geometry",
    "splat_word": "geometry",
    "color_word": "colors",
    "group_word": "codes",
    "clipline_word": "geometry",
    "ellipsoid_word": "geometry",
} | {array.name: array.part for array in DECODED}
TABLE = tuple(PREFIX + field.name for field in fields(GroupTable))


def ragged_in(header: Header) -> tuple[Array, ...]:
    """The arrays of which groups have any number of rows, in the order of `rows`. A file in archive form has those of
    its plain form, which it holds in the last one."""
    if header.archive:
        return (*ragged_in(replace(header, archive=None)), BY_NAME["archive"])
    return tuple(array for array in arrays_of(header) if array.is_ragged)


def most_rows(header: Header, array: Array) -> int:
    """What a group has no more rows of: of words and bytes by the bits that a splat may take. All have so many in the
    file."""
    n = min(GROUP, header.n_splats)
    if array.name == "archive":
        return most_archive_bytes(replace(header, archive=None))
    if "u" in array.dims:
        return most_bytes(n)
    bits = {"codes": header.n_ranks * header.entry_bits, "colors": MOST_COLOR_BITS, "splats": MOST_NUMBER_BITS}
    bits |= {extra.stream: extra.bits * extra.n_fields for extra in EXTRAS}
    return -(-n // CHUNK) * CHUNK * bits[array.name] // 32


def most_archive_bytes(header: Header) -> int:
    """Bytes of a group's arrays as they stand in plain form, with all rows that streams may have, and one byte more."""
    rows, sizes = {"n": min(GROUP, header.n_splats), "c": min(GROUP // CHUNK, header.n_chunks)}, dimensions_of(header)
    total = 1
    for array in arrays_of(header):
        if array.in_groups:
            n = most_rows(header, array) if array.is_ragged else rows[array.dims[0]]
            width = math.prod(sizes[dim] for dim in array.dims[1:] if dim not in "eu")
            total += n * width * np.dtype(array.dtype).itemsize
    return total


def rows_told(header: Header, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The words (g,) int64 of each stream, which other arrays of the same groups tell."""
    counts = group_batch_counts(arrays["batch_count"])
    told = {}
    if header.n_dictionary:
        told["codes"] = -(-(counts @ [b.n_atoms for b in header.batches]) * header.entry_bits // 32)
    for extra in EXTRAS:
        has = [extra.n_fields * getattr(batch, extra.flag) for batch in header.batches]
        if any(has):
            told[extra.stream] = -(-(counts @ has) * extra.bits // 32)
    if header.color_step:
        bits = color_bits(arrays["color_size"], header.color_step).sum(axis=1)
        words = color_words(header.n_splats, bits)
        told["colors"] = np.add.reduceat(words, np.arange(0, len(words), GROUP // CHUNK))
    if header.geometry == QUADRICS:
        told["splats"] = number_starts(arrays["batch_count"], arrays["frame_bits"])[1]
    return told


def first_words(header: Header, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Where streams that stand one group after the other begin: of each group `group_word`, `clipline_word`,
    `ellipsoid_word` and `splat_word` (g,), and of each chunk `color_word` (c,), uint32."""
    table_of = {extra.stream: extra.table for extra in EXTRAS} | {"codes": "group_word"}
    words = {table_of[name]: n for name, n in rows_told(header, arrays).items() if name in table_of}
    if header.color_step:
        bits = color_bits(arrays["color_size"], header.color_step).sum(axis=1)
        words["color_word"] = color_words(header.n_splats, bits)
    if header.geometry == QUADRICS:
        words["splat_word"] = number_starts(arrays["batch_count"], arrays["frame_bits"])[1]
    return {name: (np.cumsum(n) - n).astype(np.uint32) for name, n in words.items()}


def outline_of(header: Header, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What the table says that one group shows: its `low`, `high`, `cone` and `radius`; `n_splats` of the header is the
    group's."""
    low, high = _bounds(header, arrays)
    radius = radii_of(header, arrays)
    return {
        "low": np.where(low.astype(np.float32) > low, np.nextafter(low.astype(np.float32), np.float32(-np.inf)), low),
        "high": np.where(
            high.astype(np.float32) < high, np.nextafter(high.astype(np.float32), np.float32(np.inf)), high
        ),
        "cone": _cone(arrays["normal"]) if header.geometry == BOXES else ANY_NORMAL,
        "radius": np.array([mean_by_area(radius, np.zeros(1, np.int64))[0], radius.max()]),
    }


def mean_by_area(radius: np.ndarray, first: np.ndarray) -> np.ndarray:
    """The mean radius (g,) float64 of groups of splats that begin at `first`, each splat weighing as its area does: how
    large the splat is that a place of the surface belongs to."""
    radius = np.asarray(radius, np.float64)
    return np.add.reduceat(radius**3, first) / np.add.reduceat(radius**2, first)


def _bounds(header: Header, arrays: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    if header.runs:
        return run_bounds(header, arrays)
    if header.geometry == QUADRICS:
        box = arrays["frame_box"][0].astype(np.float64)
        return box[:3], box[3:]
    high = arrays["box_low"].astype(np.float64) + arrays["box_size"]
    return arrays["box_low"].min(axis=0).astype(np.float64), high.max(axis=0)


def radii_of(header: Header, arrays: dict[str, np.ndarray]) -> np.ndarray:
    """The radii (n,) float64 of a group's splats."""
    n = header.n_splats
    if not header.size_bits:
        return np.full(n, header.radius)
    chunk = np.arange(n) // CHUNK
    if header.geometry == QUADRICS:
        stream = np.append(arrays["splats"], np.uint32(0))
        number = unpack_numbers(stream, arrays["batch_count"], arrays["frame_bits"])
        cells = frame_sizes(arrays).astype(np.int64)[chunk]
        code = number.astype(np.int64) % cells
    else:
        code, cells = unpack_sizes(arrays["sizes"], header.size_bits, n), np.full(n, 2**header.size_bits)
    low, high = arrays["size_scale"].astype(np.float64)[chunk].T
    step = low + (high - low) * code / np.maximum(cells - 1, 1)
    return header.radius * 2.0 ** ((step - ONE_SIZE) / SIZE_STEPS_AN_OCTAVE)


def _cone(code: np.ndarray) -> np.ndarray:
    """Axis and cosine (4,) int8 of a cone that holds the normals of octahedral codes (n, 2); -127 where any may be."""
    a, b = code.astype(np.int64).T
    c = 127 - np.abs(a) - np.abs(b)
    folded = np.where(a >= 0, 1, -1) * (127 - np.abs(b)), np.where(b >= 0, 1, -1) * (127 - np.abs(a))
    normal = np.stack([np.where(c >= 0, a, folded[0]), np.where(c >= 0, b, folded[1]), c], axis=1).astype(np.float64)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    mean = normal.mean(axis=0)
    if np.linalg.norm(mean) < 1e-3:
        return ANY_NORMAL
    axis = np.rint(CONE_STEPS * mean / np.linalg.norm(mean))
    cosine = (normal @ (axis / np.linalg.norm(axis))).min()
    return np.array([*axis, max(-CONE_STEPS, np.floor(CONE_STEPS * cosine - _WIDER))], np.int8)


def check_outline(header: Header, table: GroupTable, index: int, arrays: dict[str, np.ndarray]) -> None:
    """ValueError unless the table says of group `index` what its arrays show."""
    told = outline_of(header, arrays)
    if header.geometry == QUADRICS:
        _check_box(index, arrays)
    for name in ("low", "high"):
        if not (getattr(table, name)[index] == told[name].astype(np.float32)).all():
            raise ValueError(f"group_{name} of group {index} is not that of its splats")
    if np.abs(table.cone[index].astype(int) - told["cone"]).max() > 1:
        raise ValueError(f"group_cone of group {index} is not that of its normals")
    if not np.allclose(table.radius[index], told["radius"], rtol=SAME_RADIUS, atol=0):
        raise ValueError(f"group_radius of group {index} is not that of its splats")


def _check_box(index: int, arrays: dict[str, np.ndarray]) -> None:
    """ValueError unless the box that a group's origins count in holds all of its cells."""
    check_frames(arrays)
    low, high = frame_boxes(arrays)
    box = arrays["frame_box"][0].astype(np.float64)
    off = SAME_CORNER * np.abs(box).max()  # rotations round as machines do
    if not ((low >= box[:3] - off).all() and (high <= box[3:] + off).all()):
        raise ValueError(f"group_low and group_high of group {index} do not hold its splats")
