"""What a packed file must satisfy before any of its arrays is decoded.

The bytes are hostile: the seal proves that a file is whole, not that a well-meaning program made it. So nothing is
allocated by a size that a file only claims: every zarr chunk must be there, stored as it is, and decompress to just
the bytes that its place in the layout calls for. Raises ValueError, KeyError or TypeError; PackedFile names the file.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from math import isfinite
from zipfile import ZIP_STORED, ZipFile

import numpy as np

from storage.maps import MAP_ROWS, MOST_MAPS
from storage.packed.dictionaries.shipped import ATOM_SIZE
from storage.packed.groups import GroupTable, most_rows, ragged_in
from storage.packed.layout import (
    LOCAL_HEADER_BYTES,
    ROOT_MEMBER,
    chunk_count,
    group_members,
    members_in_order,
    metadata_member,
    metadata_of,
    shape_of,
)
from storage.packed.levels import MOST_LEVELS, are_levels
from storage.packed.schema import (
    ATOM_SIZES,
    COARSEST_COLOR_STEP,
    CODER,
    FINEST_COLOR_STEP,
    FORMAT_NAME,
    FORMAT_VERSION,
    GEOMETRIES,
    LONGEST_DIRECTION,
    MAX_ATOMS,
    MIP_SIZES,
    NO_CAMERA,
    QUADRICS,
    RUNS,
    SIZE_BITS,
    TURN_COUNTS,
    Array,
    Header,
    arrays_of,
)
from storage.packed.seal import SEAL, SEAL_BYTES

MOST_MODELS = 1 << 22  # above what any header calls for
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
ZSTD_HEADER_BYTES = 18  # of a frame, at most


def check_members(archive: ZipFile, n_bytes: int) -> None:
    """The seal is in its place, and every member is stored as it is, under its own name, in bytes of its own."""
    if len(archive.comment) != SEAL_BYTES or not archive.comment.startswith(SEAL):
        raise ValueError(f"a zip with the comment {archive.comment[:32]!r}, not {SEAL!r} and a digest")
    seen, total = set(), 0
    for info in archive.infolist():
        plain = info.compress_type == ZIP_STORED and info.flag_bits == 0 and info.compress_size == info.file_size
        if not plain or info.filename in seen:
            raise ValueError(f"member {info.filename!r} is compressed, encrypted, or there twice")
        seen.add(info.filename)
        total += info.file_size
    if total > n_bytes:
        raise ValueError(f"members of {total} bytes in a file of {n_bytes}")


def read_header(archive: ZipFile) -> Header:
    """The header, with every field in its range."""
    root = json.loads(archive.read(ROOT_MEMBER))
    if (root["zarr_format"], root["node_type"]) != (3, "group"):
        raise ValueError(f"zarr_format {root['zarr_format']!r}, a {root['node_type']!r}; not 3, a group")
    attributes = root["attributes"]
    found = attributes["format"], attributes["version"]
    if found[0] != FORMAT_NAME or type(found[1]) is not int or found[1] != FORMAT_VERSION:
        raise ValueError(f"format {found[0]!r} version {found[1]!r}, not {FORMAT_NAME!r} version {FORMAT_VERSION}")
    header = Header.from_json(attributes)
    for name, value, fine, allowed in _rules(header):
        if not fine:
            raise ValueError(f"{name} {value!r}, not {allowed}")
    return header


def _rules(header: Header) -> list[tuple[str, object, bool, str]]:
    """Field, value, whether it is in its range, and that range in words."""
    h, batches, cameras = header, header.batches, header.cameras
    needed_bits = max(0, h.n_indices - 1).bit_length()
    atoms = [batch.n_atoms for batch in batches]
    return [
        ("n_splats", h.n_splats, h.n_splats >= 1, "1 or more"),
        ("radius", h.radius, h.radius > 0 and isfinite(h.radius), "positive and finite"),
        ("origin", h.origin, all(map(isfinite, h.origin)), "finite"),
        ("up", h.up, 0 < _dot(h.up, h.up) <= LONGEST_DIRECTION**2, f"a direction of length up to {LONGEST_DIRECTION}"),
        (
            "ahead",
            h.ahead,
            0 < _dot(h.ahead, h.ahead) <= LONGEST_DIRECTION**2 and _are_apart(h.up, h.ahead),
            f"a direction of length up to {LONGEST_DIRECTION}, 60 degrees or more from up",
        ),
        ("margin_radii", h.margin_radii, h.margin_radii >= 0 and isfinite(h.margin_radii), "finite, 0 or more"),
        (
            "levels",
            h.levels,
            not h.levels or (sum(h.levels) == h.n_splats and are_levels(h.levels)),
            f"2 to {MOST_LEVELS + 1} that add up to all splats, each a quarter of the next in whole groups",
        ),
        ("geometry", h.geometry, h.geometry in GEOMETRIES, f"one of {GEOMETRIES}"),
        (
            "runs",
            h.runs,
            h.geometry != RUNS or _grid_is_sound(h),
            "a cell above 0, a turn of -1..1, no more runs than splats",
        ),
        ("levels", h.levels, not (h.levels and h.runs), "none, with runs"),
        (
            "archive",
            h.archive,
            h.archive is None or _archive_is_sound(h),
            f"coder {CODER}, 0 bytes or more, models {MOST_MODELS} or fewer, no runs",
        ),
        ("size_bits", h.size_bits, h.size_bits in SIZE_BITS, f"one of {SIZE_BITS}"),
        ("size_bits", h.size_bits, h.geometry != QUADRICS or h.size_bits in (0, 4), "0 or 4 over quadrics"),
        ("dictionary_bits", h.dictionary_bits, 0 <= h.dictionary_bits <= 16, "0..16"),
        ("weight_bits", h.weight_bits, 1 <= h.weight_bits <= 8, "1..8"),
        (
            "n_dictionary",
            h.n_dictionary,
            h.n_dictionary >= 0 and needed_bits <= h.dictionary_bits,
            f"0 or more, counted with their {h.n_turns} turns in {h.dictionary_bits} bits",
        ),
        ("atom_size", h.atom_size, h.atom_size in ATOM_SIZES, f"one of {ATOM_SIZES}"),
        (
            "coarsest_size",
            h.coarsest_size,
            h.coarsest_size in MIP_SIZES and h.coarsest_size <= h.atom_size,
            f"one of {MIP_SIZES} and no more than atom_size",
        ),
        ("n_ranks", h.n_ranks, 1 <= h.n_ranks <= MAX_ATOMS, f"1..{MAX_ATOMS}"),
        (
            "color_step",
            h.color_step,
            h.color_step == 0 or FINEST_COLOR_STEP <= h.color_step <= COARSEST_COLOR_STEP,
            f"0 or {FINEST_COLOR_STEP}..{COARSEST_COLOR_STEP}",
        ),
        ("n_turns", h.n_turns, h.n_turns in TURN_COUNTS, f"one of {TURN_COUNTS}"),
        ("shipped", h.shipped, not h.shipped or _names_atoms(h), "64 digits, atoms of 16 texels, none in the file"),
        ("batches", atoms, 0 < len(set(batches)) == len(batches), "different from each other, and at least one"),
        (
            "batches",
            batches,
            not any(batch.clipline and batch.ellipsoid for batch in batches),
            "without a clipline where they are ellipsoids",
        ),
        ("n_atoms", atoms, all(0 <= n <= h.n_ranks for n in atoms), f"0..{h.n_ranks}"),
        ("n_atoms", atoms, h.n_dictionary > 0 or not any(atoms), "0 where there is no dictionary"),
        ("maps", len(h.maps), len(h.maps) <= MOST_MAPS, f"at most {MOST_MAPS}"),
        ("maps", len(h.maps), not (h.maps and h.n_dictionary), "none beside a dictionary"),
        ("maps", "of odd numbers", all(m.is_sound for m in h.maps), f"of finite numbers and whole {MAP_ROWS} rows"),
        ("cameras", len(cameras), len(cameras) <= NO_CAMERA, f"at most {NO_CAMERA}"),
        ("cameras", "of odd numbers", all(map(_camera_is_sound, cameras)), "of finite numbers and at least one pixel"),
    ]


def _dot(a: tuple[int, ...], b: tuple[int, ...]) -> int:
    return sum(x * y for x, y in zip(a, b, strict=True))


def _are_apart(a: tuple[int, ...], b: tuple[int, ...]) -> bool:
    return 4 * _dot(a, b) ** 2 <= _dot(a, a) * _dot(b, b)


def _camera_is_sound(camera) -> bool:
    numbers = (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, *camera.centre, *sum(camera.rotation, ()))
    return camera.width_px >= 1 and camera.height_px >= 1 and all(map(isfinite, numbers))


def _names_atoms(header: Header) -> bool:
    sound = re.fullmatch("[0-9a-f]{64}", header.shipped) and header.atom_size == ATOM_SIZE and header.n_dictionary > 0
    return bool(sound) and not (header.archive and header.archive.dictionary_bytes)


def _grid_is_sound(header: Header) -> bool:
    grid = header.runs
    assert grid is not None
    counts = header.n_groups <= grid.n_sections <= grid.n_runs <= header.n_splats
    return counts and 0 < grid.cell < float("inf") and all(abs(x) <= 1 for x in grid.turn)


def _archive_is_sound(header: Header) -> bool:
    form = header.archive
    assert form is not None
    has_atoms = form.dictionary_bytes == 0 or header.n_dictionary > 0
    return (
        form.coder == CODER
        and form.dictionary_bytes >= 0
        and 0 <= form.n_models <= MOST_MODELS
        and has_atoms
        and not header.runs
    )


def check_layout(archive: ZipFile, header: Header) -> None:
    """The members are just those that the header calls for, in their order, and every array is of its form."""
    arrays = arrays_of(header)
    found = archive.namelist()
    n_expected = 1 + sum(1 + chunk_count(array, shape_of(header, array)) for array in arrays)
    if len(found) != n_expected:  # before the names are listed: a crafted header may call for 2^60 of them
        raise ValueError(f"{len(found)} members, not {n_expected}")
    expected = list(_members(header))
    missing, unknown = set(expected) - set(found), set(found) - set(expected)
    if missing:
        raise ValueError(f"members missing: {sorted(missing)[:3]}, unknown: {sorted(unknown)[:3]}")
    if found != expected:
        raise ValueError("members in another order")
    for array in arrays:
        _check_metadata(archive, header, array)


def _members(header: Header) -> Iterator[str]:
    for name, group in members_in_order(header):
        yield from [name] if group is None else [member for _, member in group_members(header, group)]


def _check_metadata(archive: ZipFile, header: Header, array: Array) -> None:
    """An array's zarr.json must be the one that the writer makes."""
    found = json.loads(archive.read(metadata_member(array)))
    expected = metadata_of(array, shape_of(header, array))
    differing = sorted(key for key in expected.keys() | found.keys() if found.get(key) != expected.get(key))
    if differing:
        key = differing[0]
        raise ValueError(f"{array.name} has {key} {found.get(key)!r}, not {expected.get(key)!r}")


def check_table(archive: ZipFile, header: Header, table: GroupTable) -> None:
    """Groups lie where the table says, one member right behind the other, and nothing is longer than it can be."""
    most = np.array([most_rows(header, array) for array in ragged_in(header)], np.int64)
    if (table.rows > most).any():
        raise ValueError(f"group_rows of {table.rows.max()}, more than {most.max()}")
    for name in ("low", "high", "radius"):
        if not np.isfinite(getattr(table, name)).all():
            raise ValueError(f"group_{name} is not finite")
    at = {
        info.filename: (
            info.header_offset,
            info.header_offset + LOCAL_HEADER_BYTES + len(info.filename) + info.file_size,
        )
        for info in archive.infolist()
    }
    for index in range(header.n_groups):
        places = [at[member] for _, member in group_members(header, index)]
        together = all(stop == start for (_, stop), (start, _) in zip(places, places[1:]))
        if not together or (places[0][0], places[-1][1] - places[0][0]) != (
            int(table.start[index]),
            int(table.bytes[index]),
        ):
            raise ValueError(f"group_start and group_bytes are not where group {index} lies")


def check_frame(head: bytes, n_bytes: int) -> None:
    """A zstd frame's first ZSTD_HEADER_BYTES bytes promise `n_bytes` of contents, which is what decoders allocate.

    Reference: RFC 8878, section 3.1.1.1.
    """
    if head[:4] != ZSTD_MAGIC:
        raise ValueError(f"a chunk begins with {head[:4]!r}, not with zstd's {ZSTD_MAGIC!r}")
    descriptor = head[4]
    has_window = not descriptor >> 5 & 1
    width = (0 if has_window else 1, 2, 4, 8)[descriptor >> 6]
    start = 5 + has_window + (0, 1, 2, 4)[descriptor & 3]
    found = int.from_bytes(head[start : start + width], "little") + (256 if width == 2 else 0)
    if found != n_bytes:
        raise ValueError(f"a chunk of {found} bytes, not {n_bytes}")
