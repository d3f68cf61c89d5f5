"""Geometry, colours and codes -> the packed file as a folder, groups side by side."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.summaries import Packed
from storage.packed.batches import count_batches, rows_of
from storage.packed.bits import pack_bits
from storage.packed.codes import pack_codes
from storage.packed.colors import pack_colors
from storage.packed.packed import GROUPS_PER_ZARR_CHUNK, begin_packed, create_array, reopen_packed, seal_packed
from storage.packed.scene import streams_of
from storage.packed.schema import BY_NAME, CHUNK, EXTRAS, GROUP, Batch, Header, arrays_of, color_bits
from storage.packed.sizes import pack_sizes
from storage.work import arrays, work

TASK_SPLATS = GROUP * GROUPS_PER_ZARR_CHUNK
KIND_DIGITS = 2 ** np.arange(
    len(EXTRAS), -1, -1
)  # of `Batch.kind` as one number: a bit for each extra, above them the atoms


@dataclass(frozen=True)
class Pack:
    """A task as many groups as a zarr chunk holds. Output: the folder packed/, sealed by `write_packed`."""

    header: Header
    splats: Path
    colors: Path | None  # None: the splats have the scan's colours
    codes: Path | None
    quantized: Path | None
    extras: tuple[
        tuple[str, Path], ...
    ] = ()  # by flag of storage.packed.schema.EXTRAS: has_<flag>, <flag> of every splat
    name = "pack"

    def init(self, folder: Path) -> int:
        begin_packed(folder / "packed", self.header)
        return -(-self.header.n_splats // TASK_SPLATS)

    def run(self, folder: Path, index: int) -> dict:
        start, stop = index * TASK_SPLATS, min((index + 1) * TASK_SPLATS, self.header.n_splats)
        root = reopen_packed(folder / "packed")
        n_atoms = self._codes("n_atoms", start, stop)
        batch = self._batches(n_atoms, start, stop)
        order = np.lexsort((batch, np.arange(len(batch)) // CHUNK))
        counts = count_batches(batch[order], len(self.header.batches))
        self._write_splats(root, start, stop, order, counts)
        n_words = {}
        for name, words in (self._words(start, stop, order, counts) | self._color_words(start, stop, order)).items():
            work.write_parts(work.parts(folder) / f"{name}-{index}.npz", words=np.concatenate(words))
            n_words[name] = [len(w) for w in words]
        return {"n_splats": stop - start, "n_words": n_words}

    def finalise(self, folder: Path, results: list[dict]) -> Packed:
        root = reopen_packed(folder / "packed")
        tables = [(stream.name, stream.table) for stream in streams_of(self.header)]
        for name, table in [*tables, ("colors", "color_word")][: len(tables) + bool(self.header.color_step)]:
            self._join_words(folder, root, name, table, [n for r in results for n in r["n_words"][name]], len(results))
        if self.header.n_dictionary:
            for array in arrays_of(self.header):
                if array.part == "dictionary":
                    root[array.name][:] = arrays.read(self.quantized, array.name)[: root[array.name].shape[0]]
        return Packed(array_bytes(root, self.header))

    def _codes(self, name: str, start: int, stop: int) -> np.ndarray:
        if self.codes is None:
            return np.zeros(stop - start, np.uint8)
        return arrays.read(self.codes, name, start, stop)

    def _write_splats(self, root, start: int, stop: int, order: np.ndarray, counts: np.ndarray) -> None:
        code = arrays.read(self.splats, "position_code", start, stop)[order]
        by_splat = {
            "position": np.stack([code & 255, code >> 8 & 255, code >> 16], axis=1).astype(np.uint8),
            "normal": arrays.read(self.splats, "normal_code", start, stop)[order],
        }
        if not self.header.color_step:
            color = (self.splats, "color") if self.colors is None else (self.colors, "average")
            by_splat["color"] = arrays.read(*color, start, stop)[order].astype(np.uint8)
        if self.header.cameras:
            by_splat["camera"] = arrays.read(self.splats, "camera", start, stop)[order]
        for name, rows in by_splat.items():
            root[name][start:stop] = rows
        first, end = start // CHUNK, -(-stop // CHUNK)
        for name in ("box_low", "box_size", "box_bits"):
            root[name][first:end] = arrays.read(self.splats, name, first, end)
        root["batch_count"][first:end] = counts
        if self.header.size_bits:
            root["size_scale"][first:end] = arrays.read(self.splats, "size_scale", first, end)
            code = arrays.read(self.splats, "size_code", start, stop)[order]
            root["sizes"][first:end] = pack_sizes(code, self.header.size_bits)
        for name in ("color_low", "color_size") if self.header.color_step else ():
            root[name][first:end] = arrays.read(self.colors, name, first, end)

    def _color_words(self, start: int, stop: int, order: np.ndarray) -> dict[str, list[np.ndarray]]:
        """The words of each chunk's colours."""
        if not self.header.color_step:
            return {}
        size = arrays.read(self.colors, "color_size", start // CHUNK, -(-stop // CHUNK))
        code = arrays.read(self.colors, "color_code", start, stop)[order]
        return {"colors": pack_colors(code, color_bits(size, self.header.color_step).sum(axis=1))}

    def _batches(self, n_atoms: np.ndarray, start: int, stop: int) -> np.ndarray:
        """The batch of each splat, (n,) int64."""
        kinds = kinds_of(n_atoms, self.extras, start, stop)
        known = np.array([batch.kind for batch in self.header.batches], np.int64) @ KIND_DIGITS
        of_kind = np.full(max(kinds.max(), known.max()) + 1, -1)
        of_kind[known] = np.arange(len(known))
        batch = of_kind[kinds]
        assert (batch >= 0).all()
        return batch

    def _words(self, start: int, stop: int, order: np.ndarray, counts: np.ndarray) -> dict[str, list[np.ndarray]]:
        """The words of each group, by stream."""
        rows = rows_of(counts, self.header.batches)
        groups = [slice(g, g + GROUP) for g in range(0, stop - start, GROUP)]
        words = {}
        if self.header.n_dictionary:
            n_atoms, atom, weight = (
                self._codes(name, start, stop)[order] for name in ("n_atoms", "atom", "weight_code")
            )
            words["codes"] = [pack_codes(self.header, rows.entry[g], n_atoms[g], atom[g], weight[g]) for g in groups]
        for extra in (e for e in EXTRAS if e.stream in {s.name for s in streams_of(self.header)}):
            fields = arrays.read(dict(self.extras)[extra.flag], extra.flag, start, stop)[order].reshape(len(order), -1)
            place = rows.extra[extra.flag]
            words[extra.stream] = [pack_bits(_in_rows(fields[g], place[g]), extra.bits) for g in groups]
        return words

    def _join_words(self, folder: Path, root, name: str, table: str, n_words: list[int], n_tasks: int) -> None:
        root[table][:] = (np.cumsum(n_words) - n_words).astype(np.uint32)
        joined = create_array(root, self.header, BY_NAME[name], sum(n_words) + 1)
        pieces = (work.open_parts(work.parts(folder) / f"{name}-{index}.npz")["words"] for index in range(n_tasks))
        at, waiting = 0, np.zeros(0, np.uint32)
        for piece in [*pieces, np.zeros(1, np.uint32)]:  # the spare word
            waiting = np.concatenate([waiting, piece])
            n = len(waiting) if at + len(waiting) == joined.shape[0] else len(waiting) - len(waiting) % joined.chunks[0]
            if n:  # whole chunks: another that runs this too then never writes less of one than this does
                joined[at : at + n] = waiting[:n]
            at, waiting = at + n, waiting[n:]


def _in_rows(fields: np.ndarray, place: np.ndarray) -> np.ndarray:
    """The fields (n, k) of the splats of one group that have some, in the order of their places (n,), flat."""
    has = place >= 0
    rows = np.zeros((int(has.sum()), fields.shape[1]), np.uint32)
    rows[place[has]] = fields[has]
    return rows.ravel()


def kinds_of(n_atoms: np.ndarray, extras: tuple[tuple[str, Path], ...], start: int, stop: int) -> np.ndarray:
    """What tells the batch of each splat start..stop, `Batch.kind` as one number by KIND_DIGITS: (n,) int64."""
    flags = dict(extras)
    columns = [
        arrays.read(flags[e.flag], f"has_{e.flag}", start, stop) if e.flag in flags else np.zeros(stop - start, bool)
        for e in EXTRAS
    ]
    if {"clipline", "ellipsoid"} <= flags.keys():
        clipline, ellipsoid = ([e.flag for e in EXTRAS].index(flag) for flag in ("clipline", "ellipsoid"))
        columns[clipline] = columns[clipline] & ~columns[ellipsoid]  # the disc that would have been cut is not drawn
    digits = zip(KIND_DIGITS, [n_atoms, *columns], strict=True)
    return np.sum([digit * column.astype(np.int64) for digit, column in digits], axis=0)


def batches_of(n_splats: int, codes: Path | None, extras: tuple[tuple[str, Path], ...]) -> tuple[Batch, ...]:
    """The batches that a scan's splats make, by what they have beside atoms, then by their atoms."""
    found = set()
    for start in range(0, n_splats, arrays.BLOCK):
        stop = min(start + arrays.BLOCK, n_splats)
        n_atoms = np.zeros(stop - start, np.uint8) if codes is None else arrays.read(codes, "n_atoms", start, stop)
        found |= {
            (*(int(kind) // KIND_DIGITS[1:] % 2), kind // KIND_DIGITS[0])
            for kind in np.flatnonzero(np.bincount(kinds_of(n_atoms, extras, start, stop)))
        }
    return tuple(
        Batch(int(n), **{e.flag: bool(has) for e, has in zip(EXTRAS, flags, strict=True)})
        for *flags, n in sorted(found)
    )


def array_bytes(root, header: Header) -> dict[str, int]:
    """Bytes of each array as the GPU takes them."""
    return {array.name: int(root[array.name].nbytes) for array in arrays_of(header)}


def write_packed(pack_folder: Path, path: Path) -> None:
    """Seal what `Pack` made into one file."""
    seal_packed(pack_folder / "packed", path)
