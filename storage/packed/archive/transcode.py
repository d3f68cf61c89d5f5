"""A packed file into archive form, and back into plain form: the same groups, each on its own, side by side in threads."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from storage.errors import InvalidPackedFile
from storage.packed.archive.atoms import pack_atoms
from storage.packed.archive.coder import MOST_USES
from storage.packed.archive.continued import Looks, looks_of
from storage.packed.archive.group import code_group, group_models, pack_group, unpack_group
from storage.packed.dictionaries.levels import levels_of
from storage.packed.groups import ragged_in
from storage.packed.packed import PackedFile
from storage.packed.schema import CODER, Archived, Header, arrays_of
from storage.packed.writing.joined import lay_out, seal_packed
from storage.packed.writing.writer import begin_packed, group_of, groups_a_piece, n_pieces, write_array, write_piece
from storage.whole import aside

USES_OF_ALL = 3_000  # of a model, in all groups together, for which it pays to be known
LEARNED_FROM, LEAST_GROUPS = 16, 8  # groups that models learn from; a file of fewer than the second has no models


def has_archive_form(path: Path) -> bool:
    """Whether there is one of a packed file: none of runs, whose geometry is coded already."""
    with PackedFile(path, verify=False) as packed:
        return packed.header.runs is None


def archive_packed(source: Path, target: Path) -> None:
    """Writes what the packed file `source` holds to `target`, in archive form. The same contents, the same bytes.

    Raises InvalidPackedFile where `source` is none, or one of runs, whose geometry is coded already.
    """
    with PackedFile(source) as packed:
        header = packed.header
        if header.runs:
            raise InvalidPackedFile(str(source), "a geometry of runs, which are coded already", "boxes or quadrics")
        shared = packed.of_all()
        looks = looks_of(header, shared)
        priors = _learned(packed, looks)
        atoms = _atoms(header, shared)
        form = Archived(0 if atoms is None else len(atoms), 0 if priors is None else len(priors), CODER)
        if atoms is not None:
            shared = {n: rows for n, rows in shared.items() if not _is_level(n)} | {"archive_atoms": atoms}
        if priors is not None:
            shared["archive_models"] = priors

        def rows_of(index: int) -> dict[str, np.ndarray]:
            scene, arrays = packed.group(index), packed.rows_of_group(index)
            data = pack_group(scene, arrays, priors, looks)
            n_rows = {array.name: len(arrays[array.name]) for array in ragged_in(header)}
            box = {name: arrays[name] for name in ("frame_box",) if name in arrays}
            return unpack_group(scene.header, data, n_rows, priors, looks) | box | {"archive": data}

        _write(replace(header, archive=form), target, rows_of, shared)


def plain_packed(source: Path, target: Path) -> None:
    """Writes what the packed file `source` holds to `target`, in plain form."""
    with PackedFile(source) as packed:
        _write(packed.header, target, packed.rows_of_group, packed.of_all())


def _write(header: Header, target: Path, rows_of, shared: dict[str, np.ndarray]) -> None:
    with aside(target) as made:
        folder, step = made / "packed", groups_a_piece(header)
        begin_packed(folder, header)

        def write(piece: int) -> None:
            groups = range(header.n_groups)[piece * step : (piece + 1) * step]
            write_piece(folder, header, piece, (group_of(header, index, rows_of(index)) for index in groups))

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(write, range(n_pieces(header))))
        for array in arrays_of(header):
            if array.name in shared:  # of atoms that ship with the program the file has none
                write_array(folder, array.name, shared[array.name])
        lay_out(folder, header)
        seal_packed(folder, target)


def _is_level(name: str) -> bool:
    return name.startswith("atoms_")


def _atoms(header: Header, shared: dict[str, np.ndarray]) -> np.ndarray | None:
    """The bytes of the dictionary's atoms; none where there are none, or their levels are not means of the finest."""
    if not header.n_dictionary or header.shipped:
        return None
    finest = shared[f"atoms_{header.atom_size}"]
    for size, level in zip(header.mip_sizes, levels_of(finest, header.mip_sizes), strict=True):
        if not np.array_equal(level, shared[f"atoms_{size}"]):
            return None
    return pack_atoms(finest)


def _learned(packed: PackedFile, looks: Looks) -> np.ndarray | None:
    """What models of groups begin with, (m,) uint8: those that were often used in groups from all over the file."""
    n = packed.header.n_groups
    if n < LEAST_GROUPS:
        return None
    models = group_models(packed.header)
    for index in range(0, n, -(-n // LEARNED_FROM)):
        code_group(packed.group(index), models, looks)
    return models.known(max(MOST_USES, USES_OF_ALL // n))
