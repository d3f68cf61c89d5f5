"""Geometry, colours and codes -> the packed file as a folder, groups side by side."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from storage import arrays
from storage.batches import count_batches, rows_of
from storage.codes import pack_codes
from storage.packed import GROUPS_PER_ZARR_CHUNK, begin_packed, create_array, reopen_packed, seal_packed
from storage.schema import BY_NAME, CHUNK, GROUP, Header, arrays_of

TASK_SPLATS = GROUP * GROUPS_PER_ZARR_CHUNK


@dataclass(frozen=True)
class Pack:
    """A task as many groups as a zarr chunk holds. Output: the folder packed/, sealed by `write_packed`."""

    header: Header
    splats: Path
    patches: Path | None  # None: the splats have the scan's colours
    codes: Path | None
    quantized: Path | None
    name = "pack"

    def init(self, folder: Path) -> int:
        begin_packed(folder / "packed", self.header)
        return -(-self.header.n_splats // TASK_SPLATS)

    def run(self, folder: Path, index: int) -> dict:
        start, stop = index * TASK_SPLATS, min((index + 1) * TASK_SPLATS, self.header.n_splats)
        root = reopen_packed(folder / "packed")
        n_atoms = self._codes("n_atoms", start, stop)
        batch_of = {batch.n_atoms: i for i, batch in enumerate(self.header.batches)}
        batch = np.array([batch_of.get(n, 0) for n in range(256)])[n_atoms]
        order = np.lexsort((batch, np.arange(len(batch)) // CHUNK))
        counts = count_batches(batch[order], len(self.header.batches))
        self._write_splats(root, start, stop, order, counts)
        words = []
        if self.header.n_dictionary:
            words = self._group_words(start, stop, order, counts)
            np.save(folder / f"words-{index}.npy", np.concatenate(words))
        return {"n_splats": stop - start, "n_words": [len(w) for w in words]}

    def finalise(self, folder: Path, results: list[dict]) -> dict:
        root = reopen_packed(folder / "packed")
        if self.header.n_dictionary:
            self._join_words(folder, root, [n for r in results for n in r["n_words"]], len(results))
            for array in arrays_of(self.header):
                if array.part == "dictionary":
                    root[array.name][:] = arrays.read(self.quantized, array.name)
        return {"bytes": array_bytes(root, self.header)}

    def _codes(self, name: str, start: int, stop: int) -> np.ndarray:
        if self.codes is None:
            return np.zeros(stop - start, np.uint8)
        return arrays.read(self.codes, name, start, stop)

    def _write_splats(self, root, start: int, stop: int, order: np.ndarray, counts: np.ndarray) -> None:
        code = arrays.read(self.splats, "position_code", start, stop)[order]
        color = (self.splats, "color") if self.patches is None else (self.patches, "average")
        by_splat = {
            "position": np.stack([code & 255, code >> 8 & 255, code >> 16], axis=1).astype(np.uint8),
            "normal": arrays.read(self.splats, "normal_code", start, stop)[order],
            "color": arrays.read(*color, start, stop)[order],
        }
        if self.header.cameras:
            by_splat["camera"] = arrays.read(self.splats, "camera", start, stop)[order]
        for name, rows in by_splat.items():
            root[name][start:stop] = rows
        first, end = start // CHUNK, -(-stop // CHUNK)
        for name in ("box_low", "box_size", "box_bits"):
            root[name][first:end] = arrays.read(self.splats, name, first, end)
        root["batch_count"][first:end] = counts

    def _group_words(self, start: int, stop: int, order: np.ndarray, counts: np.ndarray) -> list[np.ndarray]:
        rows = rows_of(counts, self.header.batches)
        n_atoms, atom, weight = (self._codes(name, start, stop)[order] for name in ("n_atoms", "atom", "weight_code"))
        groups = (slice(g, g + GROUP) for g in range(0, stop - start, GROUP))
        return [pack_codes(self.header, rows.entry[g], n_atoms[g], atom[g], weight[g]) for g in groups]

    def _join_words(self, folder: Path, root, n_words: list[int], n_tasks: int) -> None:
        root["group_word"][:] = (np.cumsum(n_words) - n_words).astype(np.uint32)
        stream = create_array(root, self.header, BY_NAME["codes"], sum(n_words) + 1)
        at = 0
        for index in range(n_tasks):
            words = np.load(folder / f"words-{index}.npy")
            stream[at : at + len(words)] = words
            at += len(words)
            (folder / f"words-{index}.npy").unlink()
        stream[at:] = 0


def array_bytes(root, header: Header) -> dict[str, int]:
    """Bytes of each array as the GPU takes them."""
    return {array.name: int(root[array.name].nbytes) for array in arrays_of(header)}


def write_packed(pack_folder: Path, path: Path) -> None:
    """Seal what `Pack` made into one file."""
    seal_packed(pack_folder / "packed", path)
