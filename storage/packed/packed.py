"""The packed file: a zarr v3 group in a zip, sealed with a digest. See storage/packed/schema.py and docs/FORMAT.md.

Written by storage/packed/writing/writer.py. Groups are units: each is read, checked and decoded without a byte of the others.
"""

from __future__ import annotations

import hashlib
import os
import zipfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numcodecs.zstd import Zstd

from storage import place
from storage.errors import InternalError, InvalidPackedFile
from storage.packed.checks import ZSTD_HEADER_BYTES, check_frame, check_layout, check_members, check_table, read_header
from storage.packed.dictionaries.levels import shipped_arrays
from storage.packed.dictionaries.shipped import check_shipped
from storage.packed.groups import TABLE, GroupTable, check_outline, first_words, ragged_in, rows_told
from storage.packed.layout import MODELS, chunk_bytes, chunk_member, chunk_shape, group_members, shape_of
from storage.packed.runs.tables import DECODED, joined_tables
from storage.packed.scene import PackedScene, check_tables
from storage.packed.schema import BY_NAME, GROUP, QUADRICS, Array, Header, arrays_of, atom_arrays
from storage.packed.seal import SUFFIX, check_seal, is_packed_file
from storage.packed.totals import Totals, array_bytes

if TYPE_CHECKING:
    from storage.packed.archive.continued import Looks

__all__ = ["SUFFIX", "PackedFile", "PackedScene", "is_packed_file"]

COUNTED = 1 << 16  # chunks whose counts are read at a time


class PackedFile:
    """An opened packed file. Arrays and groups are read when asked for, and only the zarr chunks that are asked for.

    Guarantees: with `verify` (the default) any truncated or altered file raises InvalidPackedFile here; without it,
    damage is found when it is read, that of a group by its own seal. Nothing else is ever raised for a file's contents,
    and never is more memory taken than the zarr chunks that are asked for, all of which the file holds.
    """

    def __init__(self, path: str | Path, verify: bool = True) -> None:
        self.path = place.here(Path(path))
        self.n_bytes = self.path.stat().st_size
        if verify:
            check_seal(self.path)
        with _damage_is_an_error(self.path), ExitStack() as stack:
            self._archive = stack.enter_context(zipfile.ZipFile(self.path))
            check_members(self._archive, self.n_bytes)
            self._stored = read_header(self._archive)  # of what the file holds; `header` is that of its plain form
            if self._stored.shipped:
                check_shipped(str(self.path), self._stored.shipped)
            check_layout(self._archive, self._stored)
            self.header = replace(self._stored, archive=None)
            shipped = atom_arrays(self.header) if self.header.shipped else ()
            self._names = {*(array.name for array in arrays_of(self.header)), *shipped}
            table = {array.name: self._rows(array) for array in arrays_of(self._stored) if array.name in TABLE}
            stored = _table(self.header.n_groups, table)
            check_table(self._archive, self._stored, stored)
            self.groups = replace(stored, rows=stored.rows[:, : len(ragged_in(self.header))])
            self._archive_bytes = stored.rows[:, -1] if self.is_archive else None
            self._priors = self._models()
            self._handles = stack.pop_all()

    def __enter__(self) -> PackedFile:
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def close(self) -> None:
        self._handles.close()

    @property
    def is_archive(self) -> bool:
        """Whether the file is in archive form; what is read is that of its plain form either way."""
        return self._stored.archive is not None

    def read(self, name: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Rows start..stop of one array as it is stored, in the plain form."""
        if name not in self._names:
            raise KeyError(name)
        array = BY_NAME[name]
        if array in arrays_of(self._stored):
            return self._rows(array, start, stop)
        if not array.in_groups:
            return self.of_all()[name][start:stop]
        return self._rows_of_groups(array, start, stop)

    def _rows_of_groups(self, array: Array, start: int, stop: int | None) -> np.ndarray:
        """Of an array that a file in archive form holds group by group."""
        shape = shape_of(self.header, array)
        rows = range(shape[0])[start:stop]
        if not rows:
            return np.empty((0, *shape[1:]), array.dtype)
        step = chunk_shape(array, shape)[0]
        parts = [self._group_arrays(group)[array.name] for group in range(rows[0] // step, rows[-1] // step + 1)]
        if array.is_ragged:
            parts = [np.pad(part, (0, shape[1] - len(part)))[None] for part in parts]
        first = rows[0] // step * step
        return np.concatenate(parts)[rows[0] - first : rows[-1] + 1 - first]

    def _rows(self, array: Array, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Of an array that the file holds."""
        shape = shape_of(self._stored, array)
        rows = range(shape[0])[start:stop]
        if not rows:
            return np.empty((0, *shape[1:]), array.dtype)
        step = chunk_shape(array, shape)[0]
        first, last = rows[0] // step, rows[-1] // step
        with _damage_is_an_error(self.path):
            chunks = [self._chunk(array, index)[0] for index in range(first, last + 1)]
        found = chunks[0] if len(chunks) == 1 else np.concatenate(chunks)
        return found[rows[0] - first * step : rows[-1] + 1 - first * step]

    def load(self) -> PackedScene:
        """The whole file in memory, with the tables checked against each other."""
        groups = range(self.header.n_groups)
        if not self.is_archive:
            return self._checked(self.header, [self._group_arrays(index) for index in groups], self.of_all())
        with ThreadPoolExecutor(os.cpu_count()) as pool:  # a group takes far longer to decode than to read
            return self._checked(self.header, list(pool.map(self._group_arrays, groups)), self.of_all())

    def totals(self) -> Totals:
        """What there is to know of the whole file without decoding more than its counts; not of runs, whose tables on
        the GPU depend on what they are."""
        assert not self.header.runs
        counts = np.zeros(len(self.header.batches), np.int64)
        for first in range(0, self.header.n_chunks, COUNTED):
            counts += self.read("batch_count", first, first + COUNTED).sum(axis=0, dtype=np.int64)
        rows = self.groups.rows.sum(axis=0, dtype=np.int64)
        return Totals(self.header, array_bytes(self.header, rows.tolist()), counts)

    def of_all(self, part: str = "") -> dict[str, np.ndarray]:
        """The arrays that all groups share: dictionary, also one that ships with the program, maps; or those of one
        `part` alone."""
        shared = [a for a in arrays_of(self._stored) if not (a.in_groups or a.name in (*TABLE, MODELS))]
        shared = [a for a in shared if part in ("", a.part)]
        found = {array.name: self._rows(array) for array in shared}
        if "archive_atoms" in found:
            from storage.packed.archive.atoms import unpack_atoms  # compiles loops: for archives alone

            with _damage_is_an_error(self.path):
                found |= unpack_atoms(self.header, found.pop("archive_atoms"))
        if self.header.shipped:
            with _damage_is_an_error(self.path):
                found |= shipped_arrays(self.header)
        return found

    @cached_property
    def _looks(self) -> Looks:
        from storage.packed.archive.continued import looks_of

        return looks_of(self.header, self.of_all("dictionary"))

    def _models(self) -> np.ndarray | None:
        """What models of groups begin with, where the file says so."""
        if self._stored.archive is None or not self._stored.archive.n_models:
            return None
        return self._rows(BY_NAME[MODELS])

    def rows_of_group(self, index: int) -> dict[str, np.ndarray]:
        """The arrays of a group, once its seal and the table fit them: what `joined` makes a scene of."""
        return self._group_arrays(index)

    def joined(self, groups: dict[int, dict[str, np.ndarray]], of_all: dict[str, np.ndarray]) -> PackedScene:
        """Some groups, by number, as a scene without levels, in increasing order; not of runs."""
        assert not self.header.runs
        chosen = sorted(groups)
        n_splats = sum(self._header_of(index).n_splats for index in chosen)
        return self._checked(replace(self.header, n_splats=n_splats, levels=()), [groups[i] for i in chosen], of_all)

    def group(self, index: int) -> PackedScene:
        """One group of GROUP splats as a scene of its own, without the dictionary, checked like `load` and against the
        table.

        Nothing of other groups is touched. Raises IndexError where there is no such group.
        """
        if not 0 <= index < self.header.n_groups:
            raise IndexError(f"group {index} of {self.header.n_groups}")
        arrays = self._group_arrays(index)
        header, of_all = self._header_of(index), {}
        if header.runs:
            runs = replace(header.runs, n_sections=len(arrays["run_first"]), n_runs=len(arrays["run_start"]))
            header, of_all = replace(header, runs=runs), {"run_codebook": self.read("run_codebook")}
        return self._checked(header, [arrays], of_all)

    def _header_of(self, index: int) -> Header:
        """The header of one group alone, but for how many runs it has."""
        return replace(self.header, n_splats=min(GROUP, self.header.n_splats - index * GROUP), levels=())

    def _group_arrays(self, index: int) -> dict[str, np.ndarray]:
        """The rows of a group that count, once its seal and the table fit them."""
        arrays, state, header = {}, hashlib.sha256(), self._header_of(index)
        n_rows = dict(zip((array.name for array in ragged_in(self.header)), self.groups.rows[index].tolist()))
        if self._archive_bytes is not None:
            n_rows["archive"] = int(self._archive_bytes[index])
        rows_of = {"n": header.n_splats, "c": header.n_chunks}
        with _damage_is_an_error(self.path):
            for array, _ in group_members(self._stored, index):
                values, frame = self._chunk(array, index)
                state.update(frame)
                arrays[array.name] = (
                    values[0, : n_rows[array.name]] if array.is_ragged else values[: rows_of[array.dims[0]]]
                )
            if state.digest() != self.groups.seal[index].tobytes():
                raise ValueError(f"group {index} is not what its seal says")
            if self.is_archive:
                from storage.packed.archive.group import unpack_group  # compiles loops: for archives alone

                arrays = unpack_group(header, arrays["archive"], n_rows, self._priors, self._looks)
            for name, told in rows_told(header, arrays).items():
                if n_rows[name] != told[0]:
                    raise ValueError(f"group_rows says {n_rows[name]} of {name} in group {index}, its counts {told[0]}")
            if header.geometry == QUADRICS:
                box = np.concatenate([self.groups.low[index], self.groups.high[index]])
                arrays["frame_box"] = np.tile(box, (header.n_chunks, 1))
            if header.runs:
                arrays |= decoded_runs(arrays.pop("run_codes"), header.n_splats)
            check_outline(header, self.groups, index, arrays)
        return arrays

    def _checked(self, header: Header, groups: list[dict], others: dict[str, np.ndarray]) -> PackedScene:
        """The scene of consecutive groups."""
        arrays = dict(others)
        streams = {array.name for array in arrays_of(self.header) if "e" in array.dims}
        for name in groups[0]:
            spare = [np.zeros(1, np.uint32)] if name in streams else []
            arrays[name] = np.concatenate([group[name] for group in groups] + spare)
        with _damage_is_an_error(self.path):
            arrays |= first_words(header, arrays)
            if header.runs:
                sections, runs = (np.array([len(g[name]) for g in groups]) for name in ("run_first", "run_start"))
                if (sections.sum(), runs.sum()) != (header.runs.n_sections, header.runs.n_runs):
                    raise ValueError(f"groups of {sections.sum()} sections and {runs.sum()} runs, not {header.runs}")
                arrays |= joined_tables(sections, runs, arrays["run_first"])
            scene = PackedScene(header, arrays)
            check_tables(scene)
        return scene

    def _chunk(self, array: Array, index: int) -> tuple[np.ndarray, bytes]:
        """One zarr chunk, and its bytes in the file."""
        shape = shape_of(self._stored, array)
        stored, n_bytes = self._archive.read(chunk_member(array, index)), chunk_bytes(array, shape)
        raw = stored
        if array.name not in TABLE:
            check_frame(stored[:ZSTD_HEADER_BYTES], n_bytes)
            raw = Zstd().decode(stored)
        if len(raw) != n_bytes:
            raise ValueError(f"a chunk of {array.name} of {len(raw)} bytes, not {n_bytes}")
        values = np.frombuffer(raw, np.dtype(array.dtype).newbyteorder("<")).reshape(chunk_shape(array, shape))
        return values.astype(array.dtype), stored


def decoded_runs(data: np.ndarray, n_cells: int) -> dict[str, np.ndarray]:
    """The arrays DECODED of a group's `run_codes`, `run_first` counted from its first run. What compiles loops is
    loaded for runs alone."""
    from storage.packed.runs.coded import unpack_runs

    runs = unpack_runs(data, n_cells)
    return {array.name: getattr(runs, array.name.removeprefix("run_")) for array in DECODED}


def _table(n_groups: int, arrays: dict[str, np.ndarray]) -> GroupTable:
    rows = arrays.get("group_rows", np.zeros((n_groups, 0), np.uint32))
    return GroupTable(*(rows if name == "group_rows" else arrays[name] for name in TABLE))


@contextmanager
def _damage_is_an_error(path: Path) -> Iterator[None]:
    """Whatever json, zip, zstd, zarr or numpy say of a broken file becomes InvalidPackedFile."""
    try:
        yield
    except (InvalidPackedFile, InternalError):
        raise
    except Exception as error:
        found = f"{type(error).__name__}: {error}"
        raise InvalidPackedFile(str(path), found[:300], "what docs/FORMAT.md says") from error
