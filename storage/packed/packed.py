"""The packed file: a zarr v3 group in a zip, sealed with a digest. See storage/packed/schema.py and docs/FORMAT.md.

A file is written as a folder by as many tasks as there are groups, each owning whole zarr chunks, and zipped once by
one process.
"""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import zarr
from zarr.codecs import ZstdCodec
from zarr.storage import ZipStore

from storage import (
    place,
    zarr_config,  # noqa: F401 (for its effect)
)
from storage.errors import InternalError, InvalidPackedFile
from storage.packed.batches import CHUNKS_PER_GROUP, group_batch_counts
from storage.packed.checks import ZSTD_HEADER_BYTES, check_frame, check_layout, check_members, read_header
from storage.packed.colors import color_words
from storage.packed.layout import (
    GROUPS_PER_ZARR_CHUNK,
    ROOT_MEMBER,
    WORDS_PER_ZARR_CHUNK,
    ZSTD_LEVEL,
    chunk_bytes,
    chunk_member,
    chunk_shape,
    dimension_names,
    members_of,
    metadata_member,
    shape_of,
)
from storage.packed.runs import read_group
from storage.packed.scene import PackedScene, check_tables, streams_of
from storage.packed.schema import BY_NAME, GROUP, Array, Header, arrays_of, color_bits
from storage.packed.seal import UNSEALED, check_seal, is_packed_file, write_seal
from storage.whole import whole

__all__ = [
    "GROUPS_PER_ZARR_CHUNK",
    "SUFFIX",
    "WORDS_PER_ZARR_CHUNK",
    "PackedFile",
    "PackedScene",
    "begin_packed",
    "create_array",
    "is_packed_file",
    "reopen_packed",
    "seal_packed",
]

SUFFIX = ".splatpress"
_ZIP_TIME = (1980, 1, 1, 0, 0, 0)
_UNIX = 3  # zipfile's own default differs between systems


# --- writing ---------------------------------------------------------------------------------------------------------


def create_array(root: zarr.Group, header: Header, array: Array, n_words: int = 0) -> zarr.Array:
    """One array of the schema in an open group; `n_words` is the length of a word stream, spare word included.

    The one that is there already where a task that was cut short, or still runs elsewhere, has made it.
    """
    shape = shape_of(header, array, n_words)
    if array.name in root and root[array.name].shape == shape:
        return root[array.name]
    return root.create_array(
        array.name,
        shape=shape,
        chunks=chunk_shape(array, shape),
        dtype=array.dtype,
        dimension_names=dimension_names(array),
        compressors=[ZstdCodec(level=ZSTD_LEVEL)],
        fill_value=0,
    )


def begin_packed(folder: Path, header: Header) -> zarr.Group:
    """An empty packed file as a folder: its header and its fixed-length arrays, to be filled by the caller."""
    root = zarr.open_group(place.zarr_store(folder), mode="w", zarr_format=3, attributes=header.to_json())
    for array in arrays_of(header):
        if "e" not in array.dims:
            create_array(root, header, array)
    return root


def reopen_packed(folder: Path) -> zarr.Group:
    """A begun packed file, for a task that fills in its zarr chunks."""
    return zarr.open_group(place.zarr_store(folder), mode="r+", zarr_format=3)


def seal_packed(folder: Path, path: Path) -> None:
    """Zip a finished folder into `path`: same contents, same bytes. Appears under its name only when it is whole.

    Raises InternalError where a chunk was never written. What does not belong to the file, such as the leavings of a
    killed task, stays out.
    """
    members = _finished_members(folder)
    with whole(path) as partial:
        with zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
            for member in members:
                _add_member(archive, folder, member)
            archive.comment = UNSEALED
        write_seal(partial)


def _finished_members(folder: Path) -> list[str]:
    """The members of a folder that a packed file consists of, in the order of their names."""
    header = Header.from_json(json.loads(place.here(folder / ROOT_MEMBER).read_bytes())["attributes"])
    members, there = [ROOT_MEMBER], place.sizes(folder)
    for array in arrays_of(header):
        metadata = folder / metadata_member(array)
        known = metadata_member(array) in there
        shape = json.loads(place.here(metadata).read_bytes())["shape"] if known else (0,)
        members += members_of(array, tuple(shape))
    missing = [member for member in members if member not in there]
    if missing:
        raise InternalError(str(folder), f"{len(missing)} members were never written, such as {missing[0]}")
    return sorted(members)


def _add_member(archive: zipfile.ZipFile, folder: Path, member: str) -> None:
    info = zipfile.ZipInfo(member, _ZIP_TIME)
    info.create_system = _UNIX
    info.external_attr = 0o644 << 16
    file = place.here(folder / member)
    info.file_size = file.stat().st_size
    with open(file, "rb") as source, archive.open(info, "w") as target:
        shutil.copyfileobj(source, target, 1 << 20)


# --- reading ---------------------------------------------------------------------------------------------------------


class PackedFile:
    """An opened packed file. Arrays are read when asked for, and only the zarr chunks that are asked for.

    Guarantees: with `verify` (the default) any truncated or altered file raises InvalidPackedFile here; without it,
    damage is found when it is read. Nothing else is ever raised for a file's contents, and never is more memory taken
    than the zarr chunks that are asked for, all of which the file holds.
    """

    def __init__(self, path: str | Path, verify: bool = True) -> None:
        self.path = place.here(Path(path))
        self.n_bytes = self.path.stat().st_size
        if verify:
            check_seal(self.path)
        with _damage_is_an_error(self.path), ExitStack() as stack:
            self._archive = stack.enter_context(zipfile.ZipFile(self.path))
            check_members(self._archive, self.n_bytes)
            self.header = read_header(self._archive)
            self._shapes = check_layout(self._archive, self.header)
            store = ZipStore(self.path, mode="r")
            stack.callback(store.close)
            root = zarr.open_group(store, mode="r", zarr_format=3, use_consolidated=False)
            self._arrays = {name: root[name] for name in self._shapes}
            self._handles = stack.pop_all()

    def __enter__(self) -> PackedFile:
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def close(self) -> None:
        self._handles.close()

    def read(self, name: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Rows start..stop of one array."""
        opened, array, shape = self._arrays[name], BY_NAME[name], self._shapes[name]
        rows = range(shape[0])[start:stop]
        if not rows:
            return np.empty((0, *shape[1:]), array.dtype)
        rows_per_chunk = chunk_shape(array, shape)[0]
        with _damage_is_an_error(self.path):
            for index in range(rows[0] // rows_per_chunk, rows[-1] // rows_per_chunk + 1):
                with self._archive.open(chunk_member(array, index)) as member:
                    check_frame(member.read(ZSTD_HEADER_BYTES), chunk_bytes(array, shape))
            return np.asarray(opened[rows[0] : rows[-1] + 1])

    def load(self) -> PackedScene:
        """The whole file in memory, with the tables checked against each other."""
        scene = PackedScene(self.header, {name: self.read(name) for name in self._arrays})
        with _damage_is_an_error(self.path):
            check_tables(scene)
        return scene

    def group(self, index: int) -> PackedScene:
        """One group of GROUP splats as a scene of its own, without the dictionary, checked like `load`.

        Only the zarr chunks that hold the group are touched. Raises IndexError where there is no such group.
        """
        if not 0 <= index < self.header.n_groups:
            raise IndexError(f"group {index} of {self.header.n_groups}")
        spans = {"n": GROUP, "c": CHUNKS_PER_GROUP}
        arrays = {}
        for array in arrays_of(self.header):
            span = spans.get(array.dims[0])
            if span:
                arrays[array.name] = self.read(array.name, index * span, (index + 1) * span)
        with _damage_is_an_error(self.path):
            header = replace(self.header, levels=(), n_splats=min(GROUP, self.header.n_splats - index * GROUP))
            if self.header.runs:
                runs, header = read_group(self.read, self.header, index)
                arrays |= runs
            counts = group_batch_counts(arrays["batch_count"])
            for stream in streams_of(self.header):
                bounds = [*self.read(stream.table, index, index + 2), self._shapes[stream.name][0] - 1]
                first, stop = map(int, bounds[:2])
                if stop - first != stream.words(counts)[0]:
                    raise ValueError(f"{stream.table} and {stream.name} do not fit batch_count in group {index}")
                arrays[stream.name] = self.read(stream.name, first, stop + 1)
                arrays[stream.table] = np.zeros(1, np.uint32)
            if self.header.color_step:
                self._read_colors(arrays, index)
            part = PackedScene(header, arrays)
            check_tables(part)
        return part

    def _read_colors(self, group: dict[str, np.ndarray], index: int) -> None:
        """Bring the colours of one group into its arrays."""
        bits = color_bits(group["color_size"], self.header.color_step).sum(axis=1)
        first = int(group["color_word"][0])
        stop = first + int(color_words(min(GROUP, self.header.n_splats - index * GROUP), bits).sum())
        spare = self._shapes["colors"][0] - 1
        if stop > spare or (stop < spare and index + 1 == self.header.n_groups):
            raise ValueError(f"color_word and colors do not fit color_size in group {index}")
        group["colors"] = self.read("colors", first, stop + 1)
        group["color_word"] = group["color_word"] - np.uint32(first)


@contextmanager
def _damage_is_an_error(path: Path) -> Iterator[None]:
    """Whatever json, zip, zstd, zarr or numpy say of a broken file becomes InvalidPackedFile."""
    try:
        yield
    except InvalidPackedFile:
        raise
    except Exception as error:
        found = f"{type(error).__name__}: {error}"
        raise InvalidPackedFile(str(path), found[:300], "what docs/FORMAT.md says") from error
