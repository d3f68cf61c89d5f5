"""The packed file: a zarr v3 group in a zip, sealed with a digest. See storage/schema.py and docs/FORMAT.md.

A file is written as a folder by as many tasks as there are groups, each owning whole zarr chunks, and zipped once by
one process. The zip's comment is the SHA-256 of all bytes before it, so any truncated or altered file is refused.
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
import zipfile
import zlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import zarr
from zarr.codecs import ZstdCodec
from zarr.storage import ZipStore

from storage.batches import CHUNKS_PER_GROUP, Rows, group_batch_counts, rows_of
from storage.bits import words_for
from storage.codes import unpack_codes
from storage.errors import InvalidPackedFile
from storage.schema import (
    BY_NAME, CHUNK, CLIPLINE_BITS, FORMAT_NAME, FORMAT_VERSION, GROUP, MAX_ATOMS, Array, Header, arrays_of, dimensions_of,
)

SUFFIX = ".splatpress"
SEAL = b"splatpress sha256 "
GROUPS_PER_ZARR_CHUNK = 8  # 65,536 splats: the pack tasks own whole zarr chunks
WORDS_PER_ZARR_CHUNK = 1 << 16
_COMMENT_BYTES = len(SEAL) + 64
_ZIP_TIME = (1980, 1, 1, 0, 0, 0)


# --- writing ---------------------------------------------------------------------------------------------------------


def create_array(root: zarr.Group, header: Header, array: Array, n_words: int = 0) -> zarr.Array:
    """Make one array of the schema in an open group; `n_words` is the length of a word stream, spare word included."""
    sizes = dimensions_of(header) | {"e": n_words}
    shape = tuple(sizes[d] for d in array.dims)
    rows = {"n": GROUP * GROUPS_PER_ZARR_CHUNK, "c": CHUNKS_PER_GROUP * GROUPS_PER_ZARR_CHUNK,
            "e": WORDS_PER_ZARR_CHUNK, "k": 256}.get(array.dims[0], shape[0])
    chunks = tuple(max(1, c) for c in (min(rows, shape[0]), *shape[1:]))
    return root.create_array(
        array.name, shape=shape, chunks=chunks, dtype=array.dtype, dimension_names=array.dims,
        compressors=[ZstdCodec(level=9)], fill_value=0,
        config={"write_empty_chunks": True},  # a missing chunk is damage, never a run of zeros
    )


def begin_packed(folder: Path, header: Header) -> zarr.Group:
    """An empty packed file as a folder: its header and its fixed-length arrays, to be filled by the caller."""
    root = zarr.open_group(str(folder), mode="w", zarr_format=3, attributes=header.to_json())
    for array in arrays_of(header):
        if "e" not in array.dims:
            create_array(root, header, array)
    return root


def seal_packed(folder: Path, path: Path) -> None:
    """Zip a finished folder into `path`: same contents, same bytes. Appears under its name only when it is whole."""
    partial = path.with_name(path.name + ".partial")
    try:
        with zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
            for member in sorted(p for p in folder.rglob("*") if p.is_file()):
                info = zipfile.ZipInfo(member.relative_to(folder).as_posix(), _ZIP_TIME)
                info.external_attr = 0o644 << 16
                archive.writestr(info, member.read_bytes())
            archive.comment = SEAL + b"0" * 64
        with open(partial, "r+b") as file:
            digest = _digest(file, os.fstat(file.fileno()).st_size - _COMMENT_BYTES)
            file.write(SEAL + digest.encode())
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _digest(file, n_bytes: int) -> str:
    """SHA-256 of the first `n_bytes`; the file then stands right behind them."""
    file.seek(0)
    state, left = hashlib.sha256(), n_bytes
    while left > 0:
        block = file.read(min(left, 1 << 20))
        if not block:
            break
        state.update(block)
        left -= len(block)
    return state.hexdigest()


# --- reading ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PackedScene:
    """A packed file in memory: its header and, by the names of the schema, its arrays."""

    header: Header
    arrays: dict[str, np.ndarray]

    @cached_property
    def rows(self) -> Rows:
        return rows_of(self.arrays["batch_count"], self.header.batches)

    @cached_property
    def n_atoms(self) -> np.ndarray:  # (n,) int64
        return np.array([batch.n_atoms for batch in self.header.batches])[self.rows.batch]

    def codes(self, start: int = 0, stop: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Atoms and weight codes of the splats start..stop, two (n, MAX_ATOMS) int32, zero beyond their n_atoms."""
        n_atoms = self.n_atoms[start:stop]
        if not self.header.n_dictionary:
            return np.zeros((2, len(n_atoms), MAX_ATOMS), np.int32)
        group = np.arange(self.header.n_splats)[start:stop] // GROUP
        return unpack_codes(
            self.header, self.arrays["codes"], self.arrays["group_word"][group], self.rows.entry[start:stop], n_atoms
        )


class PackedFile:
    """An opened packed file. Arrays are read when asked for, and only the zarr chunks that are asked for.

    Guarantees: with `verify` (the default) any truncated or altered file raises InvalidPackedFile here; without it,
    damage is found when it is read. Nothing else is ever raised for a file's contents.
    """

    def __init__(self, path: str | Path, verify: bool = True) -> None:
        self.path = Path(path)
        self.n_bytes = self.path.stat().st_size
        if verify:
            _check_seal(self.path, self.n_bytes)
        with _damage_is_an_error(self.path):
            self._store = ZipStore(self.path, mode="r")
            self._root = zarr.open_group(self._store, mode="r", zarr_format=3)
            self.header = _checked_header(dict(self._root.attrs))
            self._arrays = {array.name: self._open(array) for array in arrays_of(self.header)}
            self._check_shapes()

    def __enter__(self) -> PackedFile:
        return self

    def __exit__(self, *_) -> None:
        self._store.close()

    def read(self, name: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Rows start..stop of one array."""
        with _damage_is_an_error(self.path):
            return np.asarray(self._arrays[name][start:stop])

    def load(self) -> PackedScene:
        """The whole file in memory, with the tables checked against each other."""
        scene = PackedScene(self.header, {name: self.read(name) for name in self._arrays})
        with _damage_is_an_error(self.path):
            _check_tables(scene)
        return scene

    def group(self, index: int) -> PackedScene:
        """One group of GROUP splats as a scene of its own; no other group's data is touched."""
        header = self.header
        spans = {"n": GROUP, "c": CHUNKS_PER_GROUP, "g": 1}
        arrays = {}
        for array in arrays_of(header):
            if array.dims[0] in spans:
                span = spans[array.dims[0]]
                arrays[array.name] = self.read(array.name, index * span, (index + 1) * span)
        counts = group_batch_counts(arrays["batch_count"])[0]
        for stream, table, width, per_batch in _streams(header):
            n_words = words_for(int(counts @ per_batch), width)
            first = int(arrays[table][0])
            arrays[stream] = self.read(stream, first, first + n_words + 1)
            arrays[table] = np.zeros(1, np.uint32)
        part = Header(**{**header.__dict__, "n_splats": len(arrays["position"])})
        return PackedScene(part, arrays)

    def _open(self, array: Array) -> zarr.Array:
        return self._root[array.name]

    def _check_shapes(self) -> None:
        sizes = dimensions_of(self.header)
        for name, opened in self._arrays.items():
            array = BY_NAME[name]
            expected = tuple(sizes.get(d, opened.shape[i]) for i, d in enumerate(array.dims))
            if opened.shape != expected or str(opened.dtype) != array.dtype:
                raise ValueError(f"array {name} is {opened.dtype} {opened.shape}, not {array.dtype} {expected}")
            if opened.nchunks_initialized != opened.nchunks:
                raise ValueError(f"array {name} has {opened.nchunks_initialized} of {opened.nchunks} chunks")


def is_packed_file(path: str | Path) -> bool:
    """Whether a file's end claims that it is a packed file; says nothing of its health."""
    path = Path(path)
    if not path.is_file() or path.stat().st_size < _COMMENT_BYTES:
        return False
    with open(path, "rb") as file:
        file.seek(-_COMMENT_BYTES, os.SEEK_END)
        return file.read(len(SEAL)) == SEAL


def _check_seal(path: Path, n_bytes: int) -> None:
    with open(path, "rb") as file:
        digest = _digest(file, max(0, n_bytes - _COMMENT_BYTES))
        comment = file.read()
    if not comment.startswith(SEAL):
        raise InvalidPackedFile(str(path), "no seal at its end", "a whole packed file", "truncated, or no packed file")
    if comment != SEAL + digest.encode():
        raise InvalidPackedFile(str(path), f"contents of SHA-256 {digest[:16]}...",
                                f"what the seal says, {comment[len(SEAL):].decode('latin-1')[:16]}...", "altered")


class _damage_is_an_error:
    """Whatever zarr, zip or numpy say of a broken file becomes InvalidPackedFile."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind, error, _trace) -> None:
        expected = (ValueError, TypeError, KeyError, IndexError, OverflowError, RuntimeError, EOFError, MemoryError,
                    OSError, NotImplementedError, AttributeError, AssertionError, struct.error, zlib.error,
                    zipfile.BadZipFile, json.JSONDecodeError)
        if isinstance(error, expected):
            raise InvalidPackedFile(str(self.path), f"{kind.__name__}: {error}", "arrays as docs/FORMAT.md says") from error


def _checked_header(attributes: dict) -> Header:
    found = attributes.get("format"), attributes.get("version")
    if found != (FORMAT_NAME, FORMAT_VERSION):
        raise ValueError(f"format {found[0]!r} version {found[1]!r}, not {FORMAT_NAME!r} version {FORMAT_VERSION}")
    header = Header.from_json(attributes)
    in_range = (
        header.n_splats >= 1, header.radius > 0, np.isfinite(header.origin).all(), header.up_axis in (0, 1, 2),
        0 <= header.depth_margin < np.inf, 0 <= header.n_dictionary <= 2**header.dictionary_bits <= 2**16,
        1 <= header.weight_bits <= 8, 1 <= len(header.batches) <= 2 * (MAX_ATOMS + 1),
        all(0 <= batch.n_atoms <= MAX_ATOMS for batch in header.batches),
    )
    if not all(in_range):
        raise ValueError(f"header field out of range (check {in_range.index(False)}): {header}")
    return header


def _streams(header: Header) -> list[tuple[str, str, int, np.ndarray]]:
    """The word streams a file has: stream, table of first words, field width, fields a splat of each batch."""
    streams = []
    if header.n_dictionary:
        streams.append(("codes", "group_word", header.entry_bits, np.array([b.n_atoms for b in header.batches])))
    if any(batch.clipline for batch in header.batches):
        clipped = np.array([int(b.clipline) for b in header.batches])
        streams.append(("cliplines", "clipline_word", CLIPLINE_BITS, clipped))
    return streams


def _check_tables(scene: PackedScene) -> None:
    header, arrays = scene.header, scene.arrays
    sizes = np.minimum(CHUNK, header.n_splats - CHUNK * np.arange(header.n_chunks))
    if not (arrays["batch_count"].sum(axis=1, dtype=np.int64) == sizes).all():
        raise ValueError("batch_count does not add up to the size of every chunk")
    if not (arrays["box_bits"].sum(axis=1, dtype=np.int64) == 24).all():
        raise ValueError("box_bits does not add up to 24 in every chunk")
    if not all(np.isfinite(arrays[name]).all() for name in ("box_low", "box_size")):
        raise ValueError("box_low or box_size is not finite")
    if not header.n_dictionary and any(batch.n_atoms for batch in header.batches):
        raise ValueError("batches with atoms, but no dictionary")
    counts = group_batch_counts(arrays["batch_count"])
    for stream, table, width, per_batch in _streams(header):
        n_words = np.array([words_for(int(n), width) for n in counts @ per_batch])
        starts = np.cumsum(n_words) - n_words
        if len(arrays[stream]) != n_words.sum() + 1 or not (arrays[table] == starts).all():
            raise ValueError(f"{table} and {stream} do not fit batch_count")
    if header.n_dictionary and int(scene.codes()[0].max(initial=0)) >= header.n_dictionary:
        raise ValueError(f"an atom index beyond the dictionary's {header.n_dictionary}")
    if header.cameras:
        camera = arrays["camera"]
        if ((camera >= len(header.cameras)) & (camera != 0xFFFF)).any():
            raise ValueError(f"a camera index beyond the {len(header.cameras)} cameras")
