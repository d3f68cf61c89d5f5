"""Writing a packed file: a folder that tasks fill side by side, each with groups of its own as they will stand in the
file; `storage/packed/writing/joined.py` makes one file of it."""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import zarr
from numcodecs.zstd import Zstd
from zarr.codecs import ZstdCodec

from storage import (
    place,
    zarr_config,  # noqa: F401 (for its effect)
)
from storage.packed.groups import PREFIX, TABLE, outline_of, ragged_in
from storage.packed.layout import ZSTD_LEVEL, chunk_shape, dimension_names, group_members, shape_of
from storage.packed.runs.tables import DECODED
from storage.packed.schema import BY_NAME, GROUP, Array, Header, arrays_of
from storage.packed.writing.zipped import local_header
from storage.whole import whole

GROUPS_AT_ONCE = 8  # of a task's, in memory: 65,536 splats
MOST_PIECES = 1 << 13
PIECES = "groups"


@dataclass(frozen=True)
class WrittenGroup:
    """What the table says of one group, but where it begins."""

    low: list[float]
    high: list[float]
    cone: list[int]
    radius: list[float]
    rows: list[int]
    bytes: int
    seal: list[int]
    crc: list[int]  # CRC-32 and bytes of its members, for the zip
    size: list[int]


def create_array(root: zarr.Group, header: Header, array: Array) -> zarr.Array:
    """One array of the schema in an open group."""
    shape = shape_of(header, array)
    return root.create_array(
        array.name,
        shape=shape,
        chunks=chunk_shape(array, shape),
        dtype=array.dtype,
        dimension_names=dimension_names(array),
        compressors=None if array.name in TABLE else [ZstdCodec(level=ZSTD_LEVEL)],
        fill_value=0,
    )


def begin_packed(folder: Path, header: Header) -> zarr.Group:
    """An empty packed file as a folder: its header and its arrays, to be filled by the caller."""
    with zarr.config.set(json_indent=None):  # of 5,000 splats half of the metadata would be spaces, 3 bytes a splat
        root = zarr.open_group(place.zarr_store(folder), mode="w", zarr_format=3, attributes=header.to_json())
        for array in arrays_of(header):
            create_array(root, header, array)
    return root


def group_of(header: Header, index: int, arrays: dict[str, np.ndarray]) -> tuple[WrittenGroup, bytes]:
    """Group `index` as it stands in the file, and what the table says of it. `arrays` are its rows by name, of streams
    the words without a spare one, of runs those of DECODED, `run_first` counted from its own first run."""
    members, crc, size, state = [], [], [], hashlib.sha256()
    if header.runs:
        arrays = arrays | {"run_codes": _coded(arrays)}
    for array, member in group_members(header, index):
        shape = chunk_shape(array, shape_of(header, array))
        rows, values = np.zeros(shape, array.dtype), arrays[array.name]
        (rows[0] if array.is_ragged else rows)[: len(values)] = values
        frame = Zstd(level=ZSTD_LEVEL).encode(rows.astype(np.dtype(array.dtype).newbyteorder("<")).tobytes())
        crc.append(zlib.crc32(frame))
        size.append(len(frame))
        members += [local_header(member, crc[-1], size[-1]), frame]
        state.update(frame)
    alone = replace(header, n_splats=min(GROUP, header.n_splats - index * GROUP))
    outline = {name: value.tolist() for name, value in outline_of(alone, arrays).items()}
    n_rows, content = [len(arrays[array.name]) for array in ragged_in(header)], b"".join(members)
    return WrittenGroup(
        **outline, rows=n_rows, bytes=len(content), seal=list(state.digest()), crc=crc, size=size
    ), content


def groups_a_piece(header: Header) -> int:
    """Groups that one task writes as one file: of a larger scan more, so that files stay few."""
    return GROUPS_AT_ONCE * max(1, -(-header.n_groups // (GROUPS_AT_ONCE * MOST_PIECES)))


def n_pieces(header: Header) -> int:
    """Files of groups."""
    return -(-header.n_groups // groups_a_piece(header))


def write_piece(folder: Path, header: Header, piece: int, groups: Iterable[tuple[WrittenGroup, bytes]]) -> None:
    """Write a piece's groups into a begun packed file. For tasks, which may run more than once, also side by side:
    pieces are there whole, and equal tasks make equal bytes."""
    rows = []
    place.make_folder(folder / PIECES)
    with whole(piece_of(folder, piece)) as partial, open(partial, "wb") as file:
        for group, content in groups:
            rows.append(tuple(getattr(group, name) for name in told_of(header).names or ()))
            file.write(content)
    with whole(told_file(folder, piece)) as partial:
        partial.write_bytes(np.array(rows, told_of(header)).tobytes())


def piece_of(folder: Path, piece: int) -> Path:
    """Its groups' members, one behind the other as they stand in the file."""
    return folder / PIECES / f"{piece:06d}"


def told_file(folder: Path, piece: int) -> Path:
    """What the table and the directory say of its groups: rows of `told_of`."""
    return folder / PIECES / f"{piece:06d}.told"


def told_of(header: Header) -> np.dtype:
    """A row of what is told of a group: the fields of WrittenGroup."""
    of_table = [(f.name, BY_NAME[PREFIX + f.name]) for f in fields(WrittenGroup) if PREFIX + f.name in BY_NAME]
    table = [(name, np.dtype(array.dtype), shape_of(header, array)[1:]) for name, array in of_table]
    n_members = sum(array.in_groups for array in arrays_of(header))
    members = [(name, np.dtype("uint32"), (n_members,)) for name in ("crc", "size")]
    return np.dtype(table + members).newbyteorder("<")


def _coded(arrays: dict[str, np.ndarray]) -> np.ndarray:
    from storage.packed.runs.coded import GroupRuns, pack_runs  # compiles loops: for runs alone

    return pack_runs(GroupRuns(*(arrays[array.name] for array in DECODED)))


def write_array(folder: Path, name: str, rows: np.ndarray) -> None:
    """A whole array that is not of groups."""
    zarr.open_group(place.zarr_store(folder), mode="r+", zarr_format=3)[name][:] = rows


def write_pieces(folder: Path, name: str, pieces: Iterable[np.ndarray]) -> None:
    """A whole array (n,) that is not of groups, from its pieces one after the other, whole zarr chunks at a time:
    another task that does this too then never writes less of one than this does."""
    array = zarr.open_group(place.zarr_store(folder), mode="r+", zarr_format=3)[name]
    at, waiting = 0, np.zeros(0, array.dtype)
    for piece in pieces:
        waiting = np.concatenate([waiting, piece])
        n = len(waiting) if at + len(waiting) == array.shape[0] else len(waiting) - len(waiting) % array.chunks[0]
        if n:
            array[at : at + n] = waiting[:n]
        at, waiting = at + n, waiting[n:]
