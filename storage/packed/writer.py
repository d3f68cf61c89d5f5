"""Writing a packed file: a folder that as many tasks fill as there are groups, each with chunks of its own, then zipped
once."""

from __future__ import annotations

import hashlib
import json
import shutil
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import zarr
from numcodecs.zstd import Zstd
from zarr.codecs import ZstdCodec

from storage import (
    place,
    zarr_config,  # noqa: F401 (for its effect)
)
from storage.errors import InternalError
from storage.packed.groups import PREFIX, TABLE, outline_of, ragged_in
from storage.packed.layout import (
    LOCAL_HEADER_BYTES,
    ROOT_MEMBER,
    ZSTD_LEVEL,
    chunk_bytes,
    chunk_shape,
    dimension_names,
    group_members,
    members_in_order,
    shape_of,
)
from storage.packed.runs.tables import DECODED
from storage.packed.schema import BY_NAME, GROUP, Array, Header, arrays_of
from storage.packed.seal import UNSEALED, write_seal
from storage.whole import whole

_ZIP_TIME = (1980, 1, 1, 0, 0, 0)
START = PREFIX + "start"
_UNIX = 3  # zipfile's own default differs between systems


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
    root = zarr.open_group(place.zarr_store(folder), mode="w", zarr_format=3, attributes=header.to_json())
    for array in arrays_of(header):
        create_array(root, header, array)
    return root


def write_group(folder: Path, header: Header, index: int, arrays: dict[str, np.ndarray]) -> WrittenGroup:
    """Write the zarr chunks of group `index` of a begun packed file. `arrays` are its rows by name, of streams the
    words without a spare one, of runs those of DECODED, `run_first` counted from its own first run. For tasks, which
    may run more than once, also side by side: chunks are there whole, and equal tasks make equal bytes."""
    n_bytes, state = 0, hashlib.sha256()
    if header.runs:
        arrays = arrays | {"run_codes": _coded(arrays)}
    for array, member in group_members(header, index):
        shape = chunk_shape(array, shape_of(header, array))
        rows, values = np.zeros(shape, array.dtype), arrays[array.name]
        (rows[0] if array.is_ragged else rows)[: len(values)] = values
        frame = Zstd(level=ZSTD_LEVEL).encode(rows.astype(np.dtype(array.dtype).newbyteorder("<")).tobytes())
        path = folder / member
        place.make_folder(path.parent)
        with whole(path) as partial:
            partial.write_bytes(frame)
        state.update(frame)
        n_bytes += LOCAL_HEADER_BYTES + len(member) + len(frame)
    alone = replace(header, n_splats=min(GROUP, header.n_splats - index * GROUP))
    outline = {name: value.tolist() for name, value in outline_of(alone, arrays).items()}
    n_rows = [len(arrays[array.name]) for array in ragged_in(header)]
    return WrittenGroup(**outline, rows=n_rows, bytes=n_bytes, seal=list(state.digest()))


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


def write_table(folder: Path, header: Header, groups: list[WrittenGroup]) -> None:
    """The table of groups, once all else is written."""
    for name in _table_names(header):
        rows = [getattr(group, name.removeprefix(PREFIX)) for group in groups] if name != START else []
        write_array(folder, name, np.array(rows or _group_starts(folder, header, groups), BY_NAME[name].dtype))


def _group_starts(folder: Path, header: Header, groups: list[WrittenGroup]) -> list[int]:
    """Where the members of each group begin in the zip."""
    table = {name: chunk_bytes(BY_NAME[name], shape_of(header, BY_NAME[name])) for name in _table_names(header)}
    at, starts, there = 0, [], place.sizes(folder)
    for name, group in members_in_order(header):
        if group is not None:
            starts.append(at)
            at += groups[group].bytes
        else:
            array = name.split("/")[0]
            is_table = array in table and "/c/" in name
            if not is_table and name not in there:
                raise InternalError(str(folder), f"{name} was never written")
            at += LOCAL_HEADER_BYTES + len(name) + (table[array] if is_table else there[name])
    return starts


def _table_names(header: Header) -> list[str]:
    return [array.name for array in arrays_of(header) if array.name in TABLE]


def seal_packed(folder: Path, path: Path) -> None:
    """Zip a finished folder into `path`: same contents, same bytes. Appears under its name only when it is whole.

    Raises InternalError where a chunk was never written. What does not belong to the file, such as the leavings of a
    killed task, stays out.
    """
    header = Header.from_json(json.loads(place.here(folder / ROOT_MEMBER).read_bytes())["attributes"])
    members = []
    for name, group in members_in_order(header):
        members += [name] if group is None else [member for _, member in group_members(header, group)]
    there = place.sizes(folder)
    missing = [member for member in members if member not in there]
    if missing:
        raise InternalError(str(folder), f"{len(missing)} members were never written, such as {missing[0]}")
    with whole(path) as partial:
        with zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
            for member in members:
                _add_member(archive, folder, member)
            archive.comment = UNSEALED
        write_seal(partial)


def _add_member(archive: zipfile.ZipFile, folder: Path, member: str) -> None:
    info = zipfile.ZipInfo(member, _ZIP_TIME)
    info.create_system = _UNIX
    info.external_attr = 0o644 << 16
    file = place.here(folder / member)
    info.file_size = file.stat().st_size
    with open(file, "rb") as source, archive.open(info, "w") as target:
        shutil.copyfileobj(source, target, 1 << 20)
