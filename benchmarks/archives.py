"""What archive form makes of packed files: bytes on disk, bits of each part of a splat, seconds of reading.

    python -m benchmarks.archives PACKED...

A part's bits are those that a file takes less without it: geometry is coded alone, then with batches, and so on, all
groups each time, with models that they begin with and that count as what a file holds of them.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numcodecs.zstd import Zstd

from storage.packed.archive.coder import MOST_USES, WRITING, begin, end
from storage.packed.archive.columns import axis_of_heights, chunks_of, form_of, kinds_of, splats_of
from storage.packed.archive.continued import Looks, looks_of
from storage.packed.archive.mixing import SIGNED_SETS, Models, fresh_models
from storage.packed.archive.splats import (
    BATCH,
    N_BATCHES,
    N_CAMERAS,
    N_COLORS,
    N_SETS,
    N_STATIONS,
    SIZE_BITS,
    SIZES,
    code_splats,
    models_of,
)
from storage.packed.archive.squares import squares_of
from storage.packed.archive.tables import MODELS_A_COLUMN, code_tables, columns_of, numbers_of, tables_in
from storage.packed.archive.transcode import LEARNED_FROM, LEAST_GROUPS, USES_OF_ALL, archive_packed
from storage.packed.layout import ZSTD_LEVEL
from storage.packed.packed import PackedFile
from storage.packed.scene import PackedScene
from storage.packed.schema import BOXES, Header

PARTS = ("geometry", "batches", "sizes", "colours", "cameras and stations", "cliplines, ellipsoids, atoms, weights")


def forms_of(header: Header) -> list[tuple[np.ndarray, np.ndarray]]:
    """What the coder is told that a file has, a part of PARTS more each time: its form, and kinds of batches."""
    whole, kinds = form_of(header), kinds_of(header)
    none, found = whole.copy(), []
    none[[N_BATCHES, SIZE_BITS, N_COLORS, N_CAMERAS, N_STATIONS]] = 1, 0, 0, 0, 0
    for names in ([], [N_BATCHES], [SIZE_BITS], [N_COLORS], [N_CAMERAS, N_STATIONS]):
        none[names] = whole[names]
        found.append((none.copy(), np.zeros_like(kinds)))
    return [*found, (whole, kinds)]


def part_bits(packed: PackedFile) -> tuple[np.ndarray, dict[str, float]]:
    """Bits a splat of PARTS, with their shares of the models that a file holds, and of tables of chunks."""
    groups = [packed.group(index) for index in range(packed.header.n_groups)]
    n, n_groups = packed.header.n_splats, len(groups)
    looks, sums = looks_of(packed.header, packed.of_all("dictionary")), np.zeros(len(PARTS))
    for part, (form, kinds) in enumerate(forms_of(packed.header)):
        fresh = fresh_models(int(models_of(form)[-1]), N_SETS)
        known = np.zeros(fresh.n_known, np.uint8)
        if n_groups >= LEAST_GROUPS:
            learned = fresh.begun(known)
            for group in groups[:: -(-n_groups // LEARNED_FROM)]:
                _bytes_of(group, learned, form, kinds, looks)
            known = learned.known(max(MOST_USES, USES_OF_ALL // n_groups))
            sums[part] += 8 * len(Zstd(ZSTD_LEVEL).encode(known))
        sums[part] += 8 * sum(_bytes_of(group, fresh.begun(known), form, kinds, looks) for group in groups)
    return np.diff(sums / n, prepend=0), _table_bits(packed.header, groups, n)


def _bytes_of(group: PackedScene, models: Models, form: np.ndarray, kinds: np.ndarray, looks: Looks) -> int:
    header = group.header
    axis = axis_of_heights(group) if header.geometry == BOXES else np.zeros(header.n_chunks, int)
    chunks, steps = chunks_of(header, group.arrays, axis)
    s, order = splats_of(group, chunks), np.arange(header.n_splats)
    if not form[SIZE_BITS]:
        chunks[:, SIZES] = 1
    s.fields[:, BATCH] *= form[N_BATCHES] > 1
    if not kinds.any():  # so that no texture is looked at where none is coded
        looks = looks_of(replace(header, n_dictionary=0), {})
    out = np.empty(1 << 16 | 1024 * len(order), np.uint8)
    state = begin(WRITING, out)
    code_splats(
        state, out, *models.pair, models_of(form), form, chunks, steps, kinds, looks.arrays,
        squares_of(header, group.arrays, axis, chunks[:, SIZES]).arrays, s.fields, s.first, s.entries, order,
    )  # fmt: skip
    return int(end(state, out))


def _table_bits(header: Header, groups: list, n: int) -> dict[str, float]:
    """Of frames or boxes, and of all other tables of chunks: the columns of each alone."""
    columns, found = columns_of(header), {}
    names = [array.name for array in tables_in(header) for _ in range(int(array.dims[1]) if len(array.dims) > 1 else 1)]
    of_geometry = np.array([name.startswith(("box_", "frame_", "normal_")) for name in names])
    for part, chosen in (("geometry", of_geometry), ("others", ~of_geometry)):
        some = columns[chosen].copy()
        if not len(some):
            continue
        models = fresh_models(MODELS_A_COLUMN * len(some), SIGNED_SETS * len(some))
        total = 0
        for group in groups:
            out = np.empty(1 << 20, np.uint8)
            state = begin(WRITING, out)
            rows = numbers_of(group.header, group.arrays)[:, np.append(chosen, True)]
            code_tables(state, out, *models.pair, 0, 0, some, np.ascontiguousarray(rows))
            total += end(state, out)
        found[part] = 8 * total / n
    return found


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("packed", nargs="+", type=Path)
    for path in parser.parse_args().packed:
        with TemporaryDirectory() as folder, PackedFile(path) as packed:
            archive, began = Path(folder) / path.name, time.perf_counter()
            archive_packed(path, archive)
            took = time.perf_counter() - began
            n, sizes = packed.header.n_finest, [file.stat().st_size for file in (path, archive)]
            print(f"{path.name}: {n:,} splats, {packed.header.geometry}, made in {took:.1f} s")
            print(f"  plain {sizes[0]:,} bytes, {sizes[0] / n:.2f} a splat; archive {sizes[1]:,}, {sizes[1] / n:.2f}")
            seconds: dict[Path, list[float]] = {path: [], archive: []}
            for file in (path, archive) * 3:
                began = time.perf_counter()
                with PackedFile(file, verify=False) as opened:
                    opened.load()
                seconds[file].append(time.perf_counter() - began)
            print(f"  loaded in {min(seconds[path]):.2f} and {min(seconds[archive]):.2f} s")
            bits, tables = part_bits(packed)
            print("  bits: " + ", ".join(f"{name} {b:.2f}" for name, b in zip(PARTS, bits, strict=True)))
            of_frames = tables["geometry"]
            print(f"  boxes or frames {of_frames:.2f}, other tables {tables.get('others', 0):.2f}")
            print(f"  geometry on disk {bits[0] + of_frames:.2f}, with batches {bits[0] + bits[1] + of_frames:.2f}")


if __name__ == "__main__":
    main()
