"""Tiny packed files from arithmetic alone: the same numbers on every machine and with every version of numpy.

Any bits make a valid position, normal, colour or code, so nothing here goes through an encoder.
"""

from __future__ import annotations

import hashlib
import shutil
from base64 import b64decode
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from storage.maps import NO_MAP, StoredMap
from storage.packed.archive.transcode import archive_packed
from storage.packed.batches import CHUNKS_PER_GROUP, group_batch_counts
from storage.packed.dictionaries.shipped import NEWEST
from storage.packed.quadrics import frame_extents
from storage.packed.runs.tables import DECODED
from storage.packed.scene import streams_of
from storage.packed.schema import (
    BOXES,
    CHUNK,
    FORMS,
    GROUP,
    NO_CAMERA,
    QUADRICS,
    RUNS,
    Batch,
    Camera,
    Header,
    RunGrid,
    arrays_of,
)
from storage.packed.seal import SEAL, SEAL_BYTES
from storage.packed.writing.joined import lay_out, seal_packed
from storage.packed.writing.writer import begin_packed, group_of, groups_a_piece, n_pieces, write_array, write_piece

UNSEALED = SEAL + b"0" * 64  # holds the seal's place in a file that is altered

LOOKING_DOWN = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))

TURN = (0.5, 0.25, -0.75, 0.0, 1.0, 0.1, 0.3, 0.6, -0.9)


@dataclass(frozen=True)
class Case:
    """What a tiny packed file holds. `period`: splats repeat after so many, which keeps a file small."""

    n_splats: int = 300
    dictionary_bits: int = 8
    weight_bits: int = 4
    n_dictionary: int = 5
    atom_counts: tuple[int, ...] = (0, 1, 3, 8)
    cliplines: bool = False
    ellipsoids: bool = False
    n_cameras: int = 2
    period: int = 1 << 40
    up: tuple[int, int, int] = (0, 0, 1)
    ahead: tuple[int, int, int] = (1, 0, 0)
    atom_size: int = 32
    n_turns: int = 1
    coarsest_size: int = 1
    n_ranks: int = 8
    color_step: int = 0
    size_bits: int = 0
    runs: bool = False
    quadrics: bool = False
    n_maps: int = 0
    archive: bool = False
    shipped: bool = False


# A WebP of 96 x 16 pixels, as encoders differ: waves of red along the columns, green along the rows.
WEBP = b64decode(
    "UklGRrIAAABXRUJQVlA4IKYAAADwBQCdASpgABAAPtFapku/paOhqqwD8BoJbACdMoR3N7d+QHJUlA/w0Oy7YtmpMRreVzKnlTQr"
    "AAD+7hmtEz4RTSHIyO71Zrf/pvSCZm1qhQgr8o+kY527HIPJBh+t1pHRe9Lw+wHfi7XMlnljN1X/s1KCZ1RRZpnbldYPAu0krY0i"
    "LwuHaE5JCdx6Rz5q9wJZecLLPp0BDDq8y02AWBiHHQbNJmAA"
)


def noise(n: int, seed: int, below: int, period: int = 1 << 40) -> np.ndarray:
    """Whole numbers (n,) int64 in 0..below, by splitmix64 of their index and a seed."""
    x = (np.arange(n) % period).astype(np.uint64) + np.uint64(seed * 0x9E3779B97F4A7C15 % 2**64)
    x *= np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return ((x ^ (x >> np.uint64(31))) % np.uint64(below)).astype(np.int64)


def header_of(case: Case) -> Header:
    plain = tuple(Batch(n) for n in case.atom_counts)
    camera = Camera("photo", 640, 480, 500.0, 505.0, 320.5, 239.5, LOOKING_DOWN, (1.0, 2.0, 30.0))
    return Header(
        n_splats=case.n_splats,
        radius=0.25,
        unit="metre",
        origin=(450000.0, 5400000.0, 100.0),
        up=case.up,
        ahead=case.ahead,
        margin_radii=2.0,
        size_bits=4 if case.quadrics and case.size_bits else case.size_bits,
        n_dictionary=case.n_dictionary,
        dictionary_bits=case.dictionary_bits,
        weight_bits=case.weight_bits,
        batches=plain
        + (tuple(Batch(n, clipline=True) for n in case.atom_counts) if case.cliplines else ())
        + (tuple(Batch(n, ellipsoid=True) for n in case.atom_counts) if case.ellipsoids else ()),
        cameras=(camera,) * case.n_cameras,
        scan={"name": "tiny", "format": "ply", "n_points": case.n_splats},
        settings={"preset": "draft"},
        atom_size=case.atom_size,
        n_turns=case.n_turns,
        coarsest_size=case.coarsest_size,
        n_ranks=case.n_ranks,
        color_step=case.color_step,
        geometry=RUNS if case.runs else QUADRICS if case.quadrics else BOXES,
        runs=RunGrid(0.7, TURN, len(_sections(case)), len(_run_lengths(case))) if case.runs else None,
        maps=tuple(
            StoredMap((450000.0 + i, 5400000.5, 90.0), 16, 2.0, 0.005 * (i + 1), len(WEBP)) for i in range(case.n_maps)
        ),
        shipped=NEWEST if case.shipped else "",
    )


def arrays_for(case: Case, header: Header) -> dict[str, np.ndarray]:
    """All arrays of a packed file, by the names of the schema."""
    n, c = header.n_splats, header.n_chunks
    arrays = {
        "box_low": (noise(3 * c, 1, 4096) / 64 - 32).reshape(c, 3).astype(np.float32),
        "box_size": (noise(3 * c, 2, 256) / 128).reshape(c, 3).astype(np.float32),
        "box_bits": np.array([[8, 8, 8], [7, 8, 9], [24, 0, 0], [0, 11, 13]], np.uint8)[noise(c, 3, 4)],
        "position": _bytes(case, 4, 256),
        "normal": (_bytes(case, 5, 255)[:, :2].astype(np.int64) - 127).astype(np.int8),
        "batch_count": _batch_count(case, header),
    }
    if case.runs:
        arrays = {name: values for name, values in arrays.items() if name not in FORMS} | _runs(case, header)
    if case.quadrics:
        arrays = {name: values for name, values in arrays.items() if name not in FORMS} | _quadrics(
            case, header, arrays["batch_count"]
        )
    if header.size_bits:
        low = noise(c, 14, 100) + 60
        arrays["size_scale"] = np.stack([low, low + noise(c, 15, 90)], axis=1).astype(np.uint8)
    if header.size_bits and not case.quadrics:
        field = noise(c * CHUNK, 16, 2**header.size_bits, case.period)
        arrays["sizes"] = _packed(field, header.size_bits).reshape(c, -1)
    arrays |= _color_boxes(case, header) if header.color_step else {"color": _bytes(case, 6, 256)}
    arrays |= _streams(case, header, arrays["batch_count"])
    if header.n_dictionary:
        arrays |= _dictionary(header)
    if header.maps:
        arrays |= _maps(case, header)
    if header.cameras:
        camera = noise(n, 7, len(header.cameras) + 1, case.period)
        arrays["camera"] = np.where(camera < len(header.cameras), camera, NO_CAMERA).astype(np.uint16)
    return arrays


def write_packed_file(case: Case, path: Path) -> Path:
    """The packed file of a case at `path`."""
    header = header_of(case)
    if not case.archive:
        return write_arrays(header, arrays_for(case, header), path)
    plain = write_arrays(header, arrays_for(case, header), path.with_suffix(".plain"))
    archive_packed(plain, path)
    plain.unlink()
    return path


def write_arrays(header: Header, arrays: dict[str, np.ndarray], path: Path) -> Path:
    """A packed file of any header and arrays of the schema, right or wrong."""
    folder = path.with_suffix(".folder")
    fill_folder(header, arrays, folder)
    seal_packed(folder, path)
    shutil.rmtree(folder)
    return path


def fill_folder(header: Header, arrays: dict[str, np.ndarray], folder: Path, edit=None) -> None:
    """As stages do it, a piece after the other; `edit` may change what the table of groups will say (a list of
    WrittenGroup)."""
    begin_packed(folder, header)
    stored = [array for array in (*arrays_of(header), *DECODED) if array.name in arrays]
    for array in stored:
        if not array.in_groups and array not in DECODED:
            write_array(folder, array.name, arrays[array.name])
    groups, contents = [], []
    for group in range(header.n_groups):
        part = {}
        for array in stored:
            if array.is_ragged or array in DECODED:
                bounds = _bounds(header, arrays, array.name)
            elif array.in_groups:
                bounds = {"n": GROUP, "c": CHUNKS_PER_GROUP}[array.dims[0]] * np.arange(header.n_groups + 1)
            else:
                continue
            part[array.name] = arrays[array.name][bounds[group] : bounds[group + 1]]
        if "frame_box" in arrays:
            part["frame_box"] = arrays["frame_box"][group * CHUNKS_PER_GROUP : (group + 1) * CHUNKS_PER_GROUP]
        if "run_first" in part:
            part["run_first"] = part["run_first"] - np.uint32(_bounds(header, arrays, "run_start")[group])
        told, content = group_of(header, group, part)
        groups.append(told)
        contents.append(content)
    made, step = list(zip(edit(groups) if edit else groups, contents, strict=True)), groups_a_piece(header)
    for piece in range(n_pieces(header)):
        write_piece(folder, header, piece, made[piece * step : (piece + 1) * step])
    lay_out(folder, header)


def seal_again(path: Path) -> None:
    """Let a file that was altered end in the seal of what it holds now."""
    content = path.read_bytes()[:-SEAL_BYTES]
    path.write_bytes(content + SEAL + hashlib.sha256(content).hexdigest().encode())


def _bounds(header: Header, arrays: dict[str, np.ndarray], name: str) -> list[int]:
    """Where the rows of each group begin in what a file holds of an array, and where the last ones end."""
    first = {
        "codes": "group_word",
        "cliplines": "clipline_word",
        "ellipsoids": "ellipsoid_word",
        "colors": "color_word",
        "splats": "splat_word",
    }
    if name in first:
        step = CHUNKS_PER_GROUP if name == "colors" else 1
        return [*arrays[first[name]][::step].tolist(), len(arrays[name]) - 1]
    sections = arrays["run_section"].tolist()
    runs = [0, *arrays["run_first"][sections[1:]].tolist(), header.runs.n_runs]
    steps = [GROUP * group - run for group, run in enumerate(runs[:-1])]
    return {
        **dict.fromkeys(("run_base", "run_first"), [*sections, header.runs.n_sections]),
        **dict.fromkeys(("run_start", "run_normal"), runs),
        "run_step": [*steps, header.n_splats - header.runs.n_runs],
    }[name]


def _color_boxes(case: Case, header: Header) -> dict[str, np.ndarray]:
    """Boxes of noise, turned any way, that reach beyond what colours there are, and any cells in them."""
    c = header.n_chunks
    size = noise(3 * c, 11, 160).reshape(c, 3) + 80
    low = noise(3 * c, 13, 8192).reshape(c, 3) - [0, 4096, 4096]
    turn = noise(3 * c, 41, 255).reshape(c, 3) - 127
    boxes = {"color_low": low.astype(np.int16), "color_size": size.astype(np.uint8), "color_turn": turn.astype(np.int8)}
    return boxes | color_stream(size, header, case.period)


def color_stream(size: np.ndarray, header: Header, period: int = 1 << 40) -> dict[str, np.ndarray]:
    """Any cells in boxes of the extents `size` (c, 3), and where those of each chunk lie."""
    bits = np.maximum(0, -((header.color_step - size.astype(np.int64)) // 16)).sum(axis=1).tolist()
    n_splats = [min(CHUNK, header.n_splats - CHUNK * i) for i in range(len(bits))]
    words = [_packed(noise(n, 12, 2**b, period), b) for n, b in zip(n_splats, bits, strict=True)]
    lengths = np.array([len(w) for w in words])
    return {
        "color_word": (np.cumsum(lengths) - lengths).astype(np.uint32),
        "colors": np.concatenate([*words, np.zeros(1, np.uint32)]),
    }


def _run_lengths(case: Case) -> np.ndarray:
    """Cells of each run: 1 to 25, none over the end of a group."""
    lengths: list[int] = []
    for n in [min(GROUP, case.n_splats - at) for at in range(0, case.n_splats, GROUP)]:
        some = np.cumsum(noise(n, 20, 25) + 1)
        lengths += np.diff([0, *some[some < n], n]).tolist()
    return np.array(lengths)


def _sections(case: Case) -> np.ndarray:
    """The first run of each section: every 40th, and that of every group."""
    ends = np.cumsum(_run_lengths(case))
    return np.union1d(np.arange(0, len(ends), 40), _first_of_groups(ends))


def _first_of_groups(ends: np.ndarray) -> np.ndarray:
    begins = np.concatenate([[0], ends[:-1]])
    return np.flatnonzero(begins % GROUP == 0)


def _runs(case: Case, header: Header) -> dict[str, np.ndarray]:
    """Any starts, turns and steps of normals; cells of a chunk whose batches are shuffled."""
    length, sections = _run_lengths(case), _sections(case)
    m, q = len(length), len(sections)
    ends = np.cumsum(length)
    turn, step = noise(case.n_splats - m, 21, 6), noise(case.n_splats - m, 22, 32)
    arrays = {
        "run_base": (noise(3 * q, 23, 4096).reshape(q, 3) - 2048).astype(np.int32),
        "run_first": sections.astype(np.uint32),
        "run_section": np.searchsorted(sections, _first_of_groups(ends)).astype(np.uint32),
        "run_start": (noise(m, 24, 1 << 27) | length - 1 << 27).astype(np.uint32),
        "run_normal": (noise(2 * m, 25, 255).reshape(m, 2) - 127).astype(np.int8),
        "run_step": (turn | step << 3).astype(np.uint8),
        "run_codebook": (noise(64, 26, 255).reshape(32, 2) - 127).astype(np.int8),
    }
    if len(header.batches) > 1:
        batch = noise(case.n_splats, 8, len(header.batches), case.period)
        arrays["run_batch"] = batch.astype(np.uint8)  # those that _batch_count counts
    return arrays


def _quadrics(case: Case, header: Header, batch_count: np.ndarray) -> dict[str, np.ndarray]:
    """Any frames, and any numbers in them, sorted in each batch and packed bit by bit: the highest in unary, the others
    a field each."""
    c, n_batches = header.n_chunks, len(header.batches)
    bits = 16 + noise(c, 31, 32)
    normals = np.where(bits > 32, 256, noise(c, 36, 256) + 1)
    arrays = {
        "frame_origin": (noise(3 * c, 30, 4096) + 12288).reshape(c, 3).astype(np.uint16),
        "frame_turn": (noise(3 * c, 39, 255) - 127).reshape(c, 3).astype(np.int8),
        "frame_step": (0x3800 + noise(c, 32, 512)).astype(np.uint16),
        "frame_cells": (noise(2 * c, 33, 300) + 1).reshape(c, 2).astype(np.uint16),
        "frame_curve": (noise(3 * c, 34, 255) - 127).reshape(c, 3).astype(np.int8),
        "frame_bits": bits.astype(np.uint8),
        "normal_low": (noise(2 * c, 35, 400) - 200).reshape(c, 2).astype(np.int16),
        "normal_cells": (np.stack([normals, np.full(c, 256)], axis=1) - 1).astype(np.uint8),
        "normal_slope": (noise(4 * c, 37, 255) - 127).reshape(c, 4).astype(np.int8),
        "normal_lean": (noise(c, 41, 255) - 127).astype(np.int8),
        "normal_grid": noise(c, 40, 16).astype(np.uint8),
    }
    reach = np.abs(frame_extents(arrays, np.ones(c))).max()  # so that cells lie in the boxes, wherever they begin
    box = np.float32([-reach, -reach / 2, 0, 7 * reach, 7 * reach, 7 * reach])
    arrays["frame_box"] = np.tile(box, (c, 1))
    splat, words = 0, []
    group: list[int] = []
    for chunk in range(c):
        stream: list[int] = []
        for n in batch_count[chunk, :n_batches].tolist():
            numbers = sorted(int(x) % 2 ** int(bits[chunk]) for x in noise(n, 38 + splat, 1 << 47, case.period))
            high = min(max(0, n - 1).bit_length(), int(bits[chunk]) - 16)
            high = high if n * high > n + 2**high else 0
            if high:
                ones = {(x >> (int(bits[chunk]) - high)) + rank for rank, x in enumerate(numbers)}
                stream += [int(i in ones) for i in range(n + 2**high)]
            stream += [x >> i & 1 for x in numbers for i in range(int(bits[chunk]) - high)]
            splat += n
        group += stream
        if chunk % CHUNKS_PER_GROUP == CHUNKS_PER_GROUP - 1 or chunk == c - 1:
            words.append(_packed(np.array(group), 1))
            group = []
    lengths = np.array([len(w) for w in words])
    arrays["splat_word"] = (np.cumsum(lengths) - lengths).astype(np.uint32)
    return arrays | {"splats": np.concatenate([*words, np.zeros(1, np.uint32)])}


def _bytes(case: Case, seed: int, below: int) -> np.ndarray:
    """(n_splats, 3) uint8."""
    columns = [noise(case.n_splats, 100 * seed + i, below, case.period) for i in range(3)]
    return np.stack(columns, axis=1).astype(np.uint8)


def _batch_count(case: Case, header: Header) -> np.ndarray:
    chunk = np.arange(header.n_splats) // CHUNK
    batch = noise(header.n_splats, 8, len(header.batches), case.period)
    counts = np.zeros((header.n_chunks, len(header.batches)), np.uint8)
    np.add.at(counts, (chunk, batch), 1)
    return counts


def _streams(case: Case, header: Header, batch_count: np.ndarray) -> dict[str, np.ndarray]:
    """Word streams of noise whose atoms are all in the dictionary, packed one bit after the other."""
    arrays = {}
    per_group = group_batch_counts(batch_count)
    for stream in streams_of(header):
        words = []
        for group, n_fields in enumerate(per_group @ stream.fields):
            if stream.name == "codes":
                atom = noise(int(n_fields), 9 + group, header.n_indices, case.period)
                weight = noise(int(n_fields), 50 + group, 2**header.weight_bits, case.period)
                field = atom | weight << header.dictionary_bits
            else:
                field = noise(int(n_fields), 90 + group, 2**stream.width, case.period)
            words.append(_packed(field, stream.width))
        lengths = np.array([len(w) for w in words])
        arrays[stream.table] = (np.cumsum(lengths) - lengths).astype(np.uint32)
        arrays[stream.name] = np.concatenate([*words, np.zeros(1, np.uint32)])
    return arrays


def _packed(field: np.ndarray, width: int) -> np.ndarray:
    """Fields as a stream of little-endian words, by way of single bits."""
    bits = (field[:, None] >> np.arange(width) & 1).astype(np.uint8).ravel()
    whole = np.zeros(-(-len(bits) // 32) * 32, np.uint8)
    whole[: len(bits)] = bits
    return np.packbits(whole, bitorder="little").view("<u4").astype(np.uint32)


def _maps(case: Case, header: Header) -> dict[str, np.ndarray]:
    """The same picture for each map; surfaces at the distances that their splats lie at, more or less, with holes."""
    n_texels, station = 6 * 16**2, noise(case.n_splats, 17, case.n_maps + 1, case.period)
    folded = np.zeros((case.n_maps, 16, 96), np.uint16)
    folded[:, 0] = 2 * (500 + noise(96, 18, 40))
    folded[:, 1:] = noise(case.n_maps * 15 * 96, 19, 9).reshape(case.n_maps, 15, 96)
    assert folded.size == case.n_maps * n_texels
    return {
        "station": np.where(station < case.n_maps, station, NO_MAP).astype(np.uint8),
        "map_colors": np.frombuffer(WEBP * case.n_maps, np.uint8),
        "map_depth_low": (folded & 255).astype(np.uint8).ravel(),
        "map_depth_high": (folded >> 8).astype(np.uint8).ravel(),
    }


def _dictionary(header: Header) -> dict[str, np.ndarray]:
    """Atoms of wide tiles, five kinds and their repeats, with their means as mip levels."""
    k, levels = header.n_dictionary, 2**header.weight_bits
    corner = noise(k * 4 * 4 * 3, 10, 255, period=4 * 4 * 3 * 5).reshape(k, 4, 4, 3) - 127
    texels = np.repeat(np.repeat(corner, 8, axis=1), 8, axis=2)
    arrays = {
        "weight_levels": (np.arange(header.n_ranks * levels).reshape(header.n_ranks, levels) / 64 - 1).astype(
            np.float32
        ),
        "atom_scale": (1 / (64 + np.arange(k))).astype(np.float32),
    }
    for size in header.mip_sizes:
        factor = 32 // size
        mean = texels.reshape(k, size, factor, size, factor, 3).mean(axis=(2, 4))
        arrays[f"atoms_{size}"] = np.round(mean).astype(np.int8)
    return arrays
