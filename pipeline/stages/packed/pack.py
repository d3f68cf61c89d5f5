"""Geometry, colours and codes -> the packed file as a folder, groups side by side."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.stages.maps.map_pictures import NAMES, stored_maps
from pipeline.stages.maps.mapped_splats import stations_in_file
from pipeline.stages.packed.kinds import KIND_DIGITS, kinds_of
from pipeline.summaries import Packed
from storage.packed.batches import CHUNKS_PER_GROUP, count_batches, rows_of
from storage.packed.bits import pack_bits, pack_sizes
from storage.packed.codes import pack_codes
from storage.packed.colors import pack_colors
from storage.packed.layout import shape_of
from storage.packed.quadrics import number_starts, pack_numbers
from storage.packed.scene import streams_of
from storage.packed.schema import (
    BY_NAME,
    CHUNK,
    COLOR_BOXES,
    EXTRAS,
    FRAMES,
    GROUP,
    QUADRICS,
    Header,
    arrays_of,
    color_bits,
)
from storage.packed.totals import array_bytes
from storage.packed.writing.joined import lay_out
from storage.packed.writing.writer import (
    GROUPS_AT_ONCE,
    WrittenGroup,
    begin_packed,
    group_of,
    groups_a_piece,
    n_pieces,
    write_array,
    write_piece,
    write_pieces,
)
from storage.work import arrays

AT_ONCE = GROUP * GROUPS_AT_ONCE  # splats


@dataclass(frozen=True)
class PackedGroups:
    """What a task tells of its groups; what the table says of them lies beside their bytes."""

    n_splats: int
    rows: list[int]  # of each array that groups have any number of rows of


@dataclass(frozen=True)
class Pack:
    """A task `groups_a_piece` groups. Output: the folder packed/, which `storage/packed/writing/joined.py` makes one file of."""

    header: Header
    splats: Path
    colors: Path | None  # None: the splats have the scan's colours
    codes: Path | None
    quantised: Path | None
    extras: tuple[
        tuple[str, Path], ...
    ] = ()  # by flag of storage.packed.schema.EXTRAS: has_<flag>, <flag> of every splat
    stations: Path | None = None  # of a scan with maps: which of them each splat has, and its mean colour
    maps: Path | None = None  # their pictures
    runs: tuple[Path, Path] | None = None  # codes and cells of the geometry runs
    name = "pack"

    def init(self, folder: Path) -> int:
        begin_packed(folder / "packed", self.header)
        return n_pieces(self.header)

    def run(self, folder: Path, index: int) -> PackedGroups:
        step = GROUP * groups_a_piece(self.header)
        told: list[list[int]] = []
        start, stop = index * step, min((index + 1) * step, self.header.n_splats)

        def groups() -> Iterator[tuple[WrittenGroup, bytes]]:
            for at in range(start, stop, AT_ONCE):
                for group in self._groups(at, min(at + AT_ONCE, stop)):
                    told.append(group[0].rows)
                    yield group

        write_piece(folder / "packed", self.header, index, groups())
        return PackedGroups(n_splats=stop - start, rows=_summed(told))

    def _groups(self, start: int, stop: int) -> Iterator[tuple[WrittenGroup, bytes]]:
        """The groups of splats start..stop."""
        n_atoms = self._codes("n_atoms", start, stop)
        batch = self._batches(n_atoms, start, stop)
        order = self._order(batch, start, stop)
        counts = count_batches(batch[order], len(self.header.batches))
        rows = self._splats(start, stop, order) | {"batch_count": counts}
        if self.runs and len(self.header.batches) > 1:
            rows["run_batch"] = batch.astype(np.uint8)
        words = self._words(start, stop, order, counts) | self._color_words(start, stop, order)
        words |= self._number_words(rows, start, stop, order, counts)
        for place in range(-(-(stop - start) // GROUP)):
            chunks = slice(place * CHUNKS_PER_GROUP, (place + 1) * CHUNKS_PER_GROUP)
            splats = slice(place * GROUP, (place + 1) * GROUP)
            of_chunks = {name for name in rows if name == "frame_box" or BY_NAME[name].dims[0] == "c"}
            part = {name: values[chunks if name in of_chunks else splats] for name, values in rows.items()}
            part |= {name: streams[place] for name, streams in words.items()}
            if self.runs:
                at = start + place * GROUP
                from pipeline.stages.runs.packing import runs_of_group

                part |= runs_of_group(*self.runs, at, min(at + GROUP, stop)) | {"run_codebook": self._codebook()}
            yield group_of(self.header, start // GROUP + place, part)

    def finalise(self, folder: Path, results: list[PackedGroups]) -> Packed:
        for array in arrays_of(self.header):
            if array.part == "dictionary":
                rows = arrays.read(self.quantised, array.name)[: shape_of(self.header, array)[0]]
                write_array(folder / "packed", array.name, rows)
        if self.maps is not None:
            stations, _ = stored_maps(self.maps)
            for name in NAMES:
                write_pieces(folder / "packed", name, (arrays.read(self.maps, f"{name}_{i}").ravel() for i in stations))
        if self.runs:
            write_array(folder / "packed", "run_codebook", self._codebook())
        lay_out(folder / "packed", self.header)
        return Packed(array_bytes(self.header, _summed([r.rows for r in results])))

    def _codebook(self) -> np.ndarray:
        assert self.runs is not None
        return arrays.read(self.runs[1], "codebook")

    def _codes(self, name: str, start: int, stop: int) -> np.ndarray:
        if self.codes is None:
            return np.zeros(stop - start, np.uint8)
        return arrays.read(self.codes, name, start, stop)

    def _splats(self, start: int, stop: int, order: np.ndarray) -> dict[str, np.ndarray]:
        """The rows of all arrays of splats and of chunks."""
        first, end = start // CHUNK, -(-stop // CHUNK)
        rows = {} if self.runs else self._frames(start, stop) if self._of_quadrics else self._boxes(start, stop, order)
        if not self.header.color_step:
            color = (self.splats, "color") if self.colors is None else (self.colors, "average")
            rows["color"] = arrays.read(*color, start, stop)[order].astype(np.uint8)
        if self.header.cameras:
            rows["camera"] = arrays.read(self.splats, "camera", start, stop)[order]
        if self.header.maps:
            rows["station"] = stations_in_file(self.stations, start, stop)[order]
        if self.header.size_bits:
            rows["size_scale"] = arrays.read(self.splats, "size_scale", first, end)
        if self.header.size_bits and not self._of_quadrics:
            code = arrays.read(self.splats, "size_code", start, stop)[order]
            rows["sizes"] = pack_sizes(code, self.header.size_bits)
        for name in COLOR_BOXES if self.header.color_step else ():
            rows[name] = arrays.read(self.colors, name, first, end)
        return rows

    @property
    def _of_quadrics(self) -> bool:
        return self.header.geometry == QUADRICS

    def _order(self, batch: np.ndarray, start: int, stop: int) -> np.ndarray:
        """Chunk by chunk, in it batch by batch, and in that by the numbers of quadrics, else as splats stood."""
        keys = (batch, np.arange(len(batch)) // CHUNK)
        return np.lexsort((arrays.read(self.splats, "number", start, stop), *keys) if self._of_quadrics else keys)

    def _frames(self, start: int, stop: int) -> dict[str, np.ndarray]:
        names = *FRAMES, "frame_box"
        return {name: arrays.read(self.splats, name, start // CHUNK, -(-stop // CHUNK)) for name in names}

    def _number_words(
        self, rows: dict[str, np.ndarray], start: int, stop: int, order: np.ndarray, counts: np.ndarray
    ) -> dict[str, list[np.ndarray]]:
        """The words of each group's numbers of quadrics."""
        if not self._of_quadrics:
            return {}
        number, bits = arrays.read(self.splats, "number", start, stop)[order], rows["frame_bits"]
        ends = np.cumsum(number_starts(counts, bits)[1])
        return {"splats": np.split(pack_numbers(number, counts, bits), ends[:-1])}

    def _boxes(self, start: int, stop: int, order: np.ndarray) -> dict[str, np.ndarray]:
        code, chunks = (
            arrays.read(self.splats, "position_code", start, stop)[order],
            (start // CHUNK, -(-stop // CHUNK)),
        )
        rows = {name: arrays.read(self.splats, name, *chunks) for name in ("box_low", "box_size", "box_bits")}
        rows["position"] = np.stack([code & 255, code >> 8 & 255, code >> 16], axis=1).astype(np.uint8)
        rows["normal"] = arrays.read(self.splats, "normal_code", start, stop)[order]
        return rows

    def _color_words(self, start: int, stop: int, order: np.ndarray) -> dict[str, list[np.ndarray]]:
        """The words of each group's colours."""
        if not self.header.color_step:
            return {}
        size = arrays.read(self.colors, "color_size", start // CHUNK, -(-stop // CHUNK))
        code = arrays.read(self.colors, "color_code", start, stop)[order]
        words = pack_colors(code, color_bits(size, self.header.color_step).sum(axis=1))
        return {
            "colors": [np.concatenate(words[i : i + CHUNKS_PER_GROUP]) for i in range(0, len(words), CHUNKS_PER_GROUP)]
        }

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


def _summed(rows: list[list[int]]) -> list[int]:
    return [sum(column) for column in zip(*rows)]


def _in_rows(fields: np.ndarray, place: np.ndarray) -> np.ndarray:
    """The fields (n, k) of the splats of one group that have some, in the order of their places (n,), flat."""
    has = place >= 0
    rows = np.zeros((int(has.sum()), fields.shape[1]), np.uint32)
    rows[place[has]] = fields[has]
    return rows.ravel()
