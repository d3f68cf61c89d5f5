"""The splats of a group as the columns that are coded, and back: streams of words and bytes are fields of theirs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from storage.maps import NO_MAP
from storage.packed.archive.splats import (
    AXES,
    BATCH,
    BLUE,
    CAMERA,
    CELLS,
    COLORS,
    COUNT,
    ELLIPSOID,
    HEIGHT,
    INDEX_BITS,
    IS_BOXES,
    IS_BYTES,
    LINE,
    N_A,
    N_BATCHES,
    N_CAMERAS,
    N_CHUNK,
    N_COLORS,
    N_FIELDS,
    N_FORMS,
    N_STATIONS,
    RED,
    SIZE,
    SIZE_BITS,
    SIZES,
    STATION,
    TURN_BITS,
    WEIGHT_BITS,
    A,
    B,
    U,
)
from storage.packed.archive.squares import PLANES
from storage.packed.batches import count_batches, rows_of
from storage.packed.bits import pack_bits, pack_sizes, unpack_bits
from storage.packed.codes import pack_codes
from storage.packed.colors import pack_colors
from storage.packed.quadrics import check_frames, frame_sizes, pack_numbers
from storage.packed.scene import POSITION_BITS, PackedScene
from storage.packed.schema import BOXES, CHUNK, EXTRAS, MOST_COLOR_BITS, NO_CAMERA, Header, color_bits

_SHARPEST = 127  # of normals' bytes, which are -127..127


@dataclass(frozen=True)
class Splats:
    """Of a group of n splats, in any order: what `code_splats` takes."""

    fields: np.ndarray  # (n, N_FIELDS) int64
    first: np.ndarray  # (n,) int64: the row of `entries` of each splat's first atom
    entries: np.ndarray  # (m, 2) int64: atom and weight


def form_of(header: Header) -> np.ndarray:
    """What holds for all splats, (N_FORMS,) int64."""
    form = np.zeros(N_FORMS, np.int64)
    form[N_BATCHES], form[SIZE_BITS], form[N_COLORS] = len(header.batches), header.size_bits, 3
    form[IS_BYTES], form[N_CAMERAS], form[N_STATIONS] = header.color_step == 0, len(header.cameras), len(header.maps)
    form[INDEX_BITS], form[WEIGHT_BITS], form[IS_BOXES] = (
        header.dictionary_bits,
        header.weight_bits,
        header.geometry == BOXES,
    )
    form[TURN_BITS] = header.n_turns.bit_length() - 1
    return form


def kinds_of(header: Header) -> np.ndarray:
    """Atoms of each batch, whether it has cliplines, whether it is ellipsoids, (b, 3) int64."""
    return np.array([batch.kind for batch in header.batches], np.int64)


def check_chunks(header: Header, tables: dict[str, np.ndarray]) -> None:
    """ValueError unless tables are what `chunks_of` takes them for, so that cells and colours have no more bits than
    those of a plain file may."""
    if header.geometry == BOXES:
        bits, size = tables["box_bits"].astype(np.int64), tables["box_size"]
        if not (bits.sum(axis=1) == POSITION_BITS).all():
            raise ValueError(f"box_bits does not add up to {POSITION_BITS} in every chunk")
        if not (np.isfinite(size).all() and size.min() >= 0):
            raise ValueError("box_size is not finite, or less than 0")
    else:
        check_frames(tables)
    if header.color_step and color_bits(tables["color_size"], header.color_step).sum(axis=1).max() > MOST_COLOR_BITS:
        raise ValueError(f"colours of more than {MOST_COLOR_BITS} bits a splat")


def chunks_of(header: Header, tables: dict[str, np.ndarray], axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What is known of each chunk, (c, N_CHUNK) int64, and the sides of its cells as shares of the longest, (c, 3)
    float64; `axis` (c,) is that of heights, of boxes."""
    n_chunks = header.n_chunks
    chunks, steps = np.zeros((n_chunks, N_CHUNK), np.int64), np.ones((n_chunks, 3))
    chunks[:, SIZES] = 1 << header.size_bits
    chunks[:, COUNT] = np.minimum(CHUNK, header.n_splats - CHUNK * np.arange(n_chunks))
    if header.geometry == BOXES:
        axes = PLANES[axis]
        bits = np.take_along_axis(tables["box_bits"].astype(np.int64), axes, axis=1)
        side = np.take_along_axis(tables["box_size"].astype(np.float64), axes, axis=1) / 2.0**bits
        longest = side.max(axis=1, keepdims=True)
        steps = np.where(longest > 0, side / np.where(longest > 0, longest, 1), 1.0)
        chunks[:, CELLS : CELLS + 3], chunks[:, N_A : N_A + 2] = 1 << bits, 2 * _SHARPEST + 1
        chunks[:, AXES : AXES + 3] = axes
    else:
        cells, normals = tables["frame_cells"].astype(np.int64), tables["normal_cells"].astype(np.int64) + 1
        chunks[:, CELLS : CELLS + 2], chunks[:, N_A : N_A + 2] = cells, normals
        states = cells.prod(axis=1) * normals.prod(axis=1)
        chunks[:, SIZES] = frame_sizes(tables)
        chunks[:, CELLS + 2] = -(-(1 << tables["frame_bits"].astype(np.int64)) // (states * chunks[:, SIZES]))
    of_colors = color_bits(tables["color_size"], header.color_step) if header.color_step else 8
    chunks[:, COLORS : COLORS + 3] = 1 << of_colors
    return chunks, steps


def axis_of_heights(scene: PackedScene) -> np.ndarray:
    """The axis (c,) that normals of each chunk are nearest to, of boxes."""
    a, b = scene.arrays["normal"].astype(np.int64).T
    c = _SHARPEST - np.abs(a) - np.abs(b)
    folded = c < 0
    size = np.stack(
        [
            np.where(folded, _SHARPEST - np.abs(b), np.abs(a)),
            np.where(folded, _SHARPEST - np.abs(a), np.abs(b)),
            np.abs(c),
        ],
        axis=1,
    )
    return np.add.reduceat(size, np.arange(0, len(size), CHUNK), axis=0).argmax(axis=1)


def splats_of(scene: PackedScene, chunks: np.ndarray) -> Splats:
    """The columns of a group, of what `chunks_of` says."""
    header, arrays = scene.header, scene.arrays
    n, own = header.n_splats, chunks[np.arange(header.n_splats) // CHUNK]
    fields = np.zeros((n, N_FIELDS), np.int64)
    if header.geometry == BOXES:
        bits = np.log2(1 << arrays["box_bits"].astype(np.int64)).astype(np.int64)[np.arange(n) // CHUNK]
        byte = arrays["position"].astype(np.int64)
        number = byte[:, 0] | byte[:, 1] << 8 | byte[:, 2] << 16
        shift = np.stack([0 * bits[:, 0], bits[:, 0], bits[:, 0] + bits[:, 1]], axis=1)
        cells = (number[:, None] >> shift) & ((1 << bits) - 1)
        fields[:, U : U + 3] = np.take_along_axis(cells, own[:, AXES : AXES + 3], axis=1)
        fields[:, A : A + 2] = arrays["normal"].astype(np.int64) + _SHARPEST
    else:
        number = scene.numbers // own[:, SIZES].astype(np.uint64)
        for column, n_states in ((A, N_A), (B, N_A + 1), (U, CELLS), (U + 1, CELLS + 1)):
            number, rest = np.divmod(number, own[:, n_states].astype(np.uint64))
            fields[:, column] = rest
        fields[:, HEIGHT] = number
    fields[:, BATCH] = scene.rows.batch
    if header.size_bits:
        fields[:, SIZE] = scene.size_codes
    if header.color_step:
        fields[:, RED : BLUE + 1] = _split(scene.color_cells.astype(np.int64), own)
    else:
        fields[:, RED : BLUE + 1] = arrays["color"]
    if header.cameras:
        fields[:, CAMERA] = np.where(arrays["camera"] == NO_CAMERA, len(header.cameras), arrays["camera"])
    if header.maps:
        fields[:, STATION] = np.where(arrays["station"] == NO_MAP, len(header.maps), arrays["station"])
    lines = np.flatnonzero(scene.rows.clipline >= 0)
    if len(lines):
        fields[lines, LINE] = unpack_bits(arrays["cliplines"], 12 * scene.rows.clipline[lines], 12)
    splat, word = scene.ellipsoids
    fields[splat, ELLIPSOID] = word.astype(np.int64) @ (1 << 8 * np.arange(4))
    atom, weight = scene.codes()
    used = np.arange(header.n_ranks) < scene.n_atoms[:, None]
    entries = np.stack([atom[used], weight[used]], axis=1).astype(np.int64)
    return Splats(fields, scene.n_atoms.cumsum() - scene.n_atoms, entries)


def _bits_of(n: np.ndarray) -> np.ndarray:
    """Bits of cells whose number is a power of two."""
    return np.frexp(n.astype(np.float64))[1] - 1


def _split(code: np.ndarray, own: np.ndarray) -> np.ndarray:
    """The three cells (n, 3) of colours (n,)."""
    bits = _bits_of(own[:, COLORS : COLORS + 3])
    shift = np.cumsum(bits, axis=1) - bits
    return (code[:, None] >> shift) & ((1 << bits) - 1)


def arrays_of_splats(
    header: Header, tables: dict[str, np.ndarray], chunks: np.ndarray, splats: Splats
) -> dict[str, np.ndarray]:
    """The way back: the group's arrays as a file has them. Splats are put batch by batch, those over quadrics by their
    numbers, all others as they stand.

    Raises: ValueError where numbers are beyond the bits of their chunk.
    """
    n, chunk = header.n_splats, np.arange(header.n_splats) // CHUNK
    fields, own = splats.fields, chunks[chunk]
    keys: tuple[np.ndarray, ...] = (fields[:, BATCH], chunk)
    number = None
    if header.geometry != BOXES:
        number = np.zeros(n, np.uint64)
        digits = (HEIGHT, None), (U + 1, CELLS + 1), (U, CELLS), (B, N_A + 1), (A, N_A), (SIZE, SIZES)
        for column, n_states in digits:
            number = number * (own[:, n_states].astype(np.uint64) if n_states else np.uint64(1))
            number += fields[:, column].astype(np.uint64)
        if (number >> tables["frame_bits"][chunk].astype(np.uint64)).any():
            raise ValueError("a number of a splat beyond its chunk's bits")
        keys = (number, *keys)
    order = np.lexsort(keys)
    fields, entry = fields[order], splats.first[order]
    batch_count = count_batches(fields[:, BATCH], len(header.batches))
    arrays = tables | {"batch_count": batch_count}
    if number is None:
        arrays |= _boxes(fields, own)
    else:
        arrays["splats"] = pack_numbers(number[order], batch_count, tables["frame_bits"])
    if header.size_bits and header.geometry == BOXES:
        arrays["sizes"] = pack_sizes(fields[:, SIZE], header.size_bits).astype(np.uint32)
    color = fields[:, RED : BLUE + 1]
    if header.color_step:
        bits = _bits_of(chunks[:, COLORS : COLORS + 3])
        code = (color << (np.cumsum(bits, axis=1) - bits)[chunk]).sum(axis=1)
        arrays["colors"] = np.concatenate(pack_colors(code, bits.sum(axis=1)))
    else:
        arrays["color"] = color.astype(np.uint8)
    if header.cameras:
        camera = fields[:, CAMERA]
        arrays["camera"] = np.where(camera == len(header.cameras), NO_CAMERA, camera).astype(np.uint16)
    if header.maps:
        station = fields[:, STATION]
        arrays["station"] = np.where(station == len(header.maps), NO_MAP, station).astype(np.uint8)
    return arrays | _streams(header, batch_count, fields, entry, splats.entries)


def _boxes(fields: np.ndarray, own: np.ndarray) -> dict[str, np.ndarray]:
    cells, bits = np.zeros((2, len(fields), 3), np.int64)
    np.put_along_axis(cells, own[:, AXES : AXES + 3], fields[:, U : U + 3], axis=1)
    np.put_along_axis(bits, own[:, AXES : AXES + 3], _bits_of(own[:, CELLS : CELLS + 3]), axis=1)
    number = (cells << (np.cumsum(bits, axis=1) - bits)).sum(axis=1)
    return {
        "position": np.stack([number & 255, number >> 8 & 255, number >> 16], axis=1).astype(np.uint8),
        "normal": (fields[:, A : A + 2] - _SHARPEST).astype(np.int8),
    }


def _streams(
    header: Header, batch_count: np.ndarray, fields: np.ndarray, first: np.ndarray, entries: np.ndarray
) -> dict[str, np.ndarray]:
    rows, streams = rows_of(batch_count, header.batches), {}
    if header.n_dictionary:
        n_atoms = np.array([batch.n_atoms for batch in header.batches])[rows.batch]
        place = first[:, None] + np.arange(header.n_ranks)
        spread = np.concatenate([entries, np.zeros((header.n_ranks + 1, 2), np.int64)])[np.minimum(place, len(entries))]
        streams["codes"] = pack_codes(header, rows.entry, n_atoms, spread[..., 0], spread[..., 1])
    for extra, column in zip(EXTRAS, (LINE, ELLIPSOID), strict=True):
        place = rows.extra[extra.flag]
        has = place >= 0
        if any(getattr(batch, extra.flag) for batch in header.batches):
            words = np.zeros(int(has.sum()), np.int64)
            words[place[has]] = fields[has, column]
            streams[extra.stream] = pack_bits(words, extra.bits * extra.n_fields)
    return streams
