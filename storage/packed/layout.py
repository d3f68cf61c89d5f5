"""Where each array's bytes lie: its zarr chunks, the members of the zip that hold them, and its zarr.json.

All of it follows from the header, so a reader never takes a file's word for it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from storage.packed.batches import CHUNKS_PER_GROUP
from storage.packed.groups import TABLE, most_rows
from storage.packed.schema import GROUP, Array, Header, arrays_of, dimensions_of

TABLE_ROWS_PER_ZARR_CHUNK = 4096
ATOMS_PER_ZARR_CHUNK = 256
BYTES_PER_ZARR_CHUNK = 1 << 20
ZSTD_LEVEL = 9
ROOT_MEMBER = "zarr.json"
MODELS = "archive_models"  # what groups are decoded with, so it stands before them
LOCAL_HEADER_BYTES = 30  # of a member of a zip, beside its name


def shape_of(header: Header, array: Array) -> tuple[int, ...]:
    """The shape of an array."""
    sizes = dimensions_of(header)
    if array.is_ragged:
        return header.n_groups, most_rows(header, array), *(sizes[d] for d in array.dims[2:])
    return tuple(sizes[d] for d in array.dims)


def chunk_shape(array: Array, shape: tuple[int, ...]) -> tuple[int, ...]:
    """The shape of an array's zarr chunks: whole rows, those of a group where it is one of `in_groups`."""
    if array.is_ragged:
        return 1, *(max(1, n) for n in shape[1:])
    rows = {"n": GROUP, "c": CHUNKS_PER_GROUP, "g": TABLE_ROWS_PER_ZARR_CHUNK, "k": ATOMS_PER_ZARR_CHUNK}
    rows |= dict.fromkeys("xyz", BYTES_PER_ZARR_CHUNK)
    return tuple(max(1, c) for c in (min(rows.get(array.dims[0], shape[0]), shape[0]), *shape[1:]))


def chunk_count(array: Array, shape: tuple[int, ...]) -> int:
    """How many chunks an array of that shape is kept in."""
    return -(-shape[0] // chunk_shape(array, shape)[0])


def chunk_member(array: Array, index: int) -> str:
    """The zip's member that holds zarr chunk `index` along the first axis, the only one that is split."""
    return f"{array.name}/c/{index}" + "/0" * (len(array.dims) - 1)


def metadata_member(array: Array) -> str:
    """The member of the archive that describes an array."""
    return f"{array.name}/{ROOT_MEMBER}"


def group_members(header: Header, index: int) -> list[tuple[Array, str]]:
    """The arrays that a group has rows of, and the members that hold them, in the order of the file."""
    return [(array, chunk_member(array, index)) for array in arrays_of(header) if array.in_groups]


def n_first_groups(header: Header) -> int:
    """Groups of the coarsest level, which stand before the dictionary; none in a file of one level."""
    return header.levels[0] // GROUP if header.levels else 0


def members_before_groups(header: Header) -> Iterator[str]:
    """What a file begins with: header and metadata, the table of groups, the models that groups begin with."""
    arrays = arrays_of(header)
    yield ROOT_MEMBER
    yield from (metadata_member(array) for array in arrays)
    for names in (TABLE, (MODELS,)):
        yield from (member for array in arrays if array.name in names for member in _chunks_of(header, array))


def members_of_all(header: Header) -> Iterator[str]:
    """What all groups share, and stands behind those of the coarsest level: dictionary, maps."""
    others = [array for array in arrays_of(header) if array.name not in (*TABLE, MODELS) and not array.in_groups]
    yield from (member for array in others for member in _chunks_of(header, array))


def members_in_order(header: Header) -> Iterator[tuple[str, int | None]]:
    """The order of a file: header and metadata, the table of groups, the models that groups begin with, the coarsest
    level, the dictionary, all other groups. Members' names with None, and for the members of a group, as
    `group_members` has them, its number."""
    n_first = n_first_groups(header)
    yield from ((member, None) for member in members_before_groups(header))
    yield from (("", index) for index in range(n_first))
    yield from ((member, None) for member in members_of_all(header))
    yield from (("", index) for index in range(n_first, header.n_groups))


def _chunks_of(header: Header, array: Array) -> list[str]:
    return [chunk_member(array, index) for index in range(chunk_count(array, shape_of(header, array)))]


def chunk_bytes(array: Array, shape: tuple[int, ...]) -> int:
    """Bytes of a zarr chunk when decompressed; the last one is as long as the others."""
    return int(np.prod(chunk_shape(array, shape))) * np.dtype(array.dtype).itemsize


def bytes_on_gpu(header: Header, array: Array, n_bytes: int) -> int:
    """Of an array of `n_bytes` as a GPU takes it: as it stands, but the pictures of maps, which become textures with
    coarser levels beside them, 9 heights squared of RGBA."""
    return sum(36 * stored.height_px**2 for stored in header.maps) if array.name == "map_colors" else n_bytes


def dimension_names(array: Array) -> list[str | None]:
    """Of dimensions with a name; one of a fixed size has none, for some readers want all names to differ (32 x 32
    texels)."""
    return [None if dim.isdigit() else dim for dim in array.dims]


def metadata_of(array: Array, shape: tuple[int, ...]) -> dict:
    """What an array's zarr.json says, word for word."""
    little = {"configuration": {"endian": "little"}} if np.dtype(array.dtype).itemsize > 1 else {}
    zstd = {"name": "zstd", "configuration": {"level": ZSTD_LEVEL, "checksum": False}}
    return {
        "zarr_format": 3,
        "node_type": "array",
        "shape": list(shape),
        "data_type": array.dtype,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": list(chunk_shape(array, shape))}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "codecs": [{"name": "bytes", **little}, *([] if array.name in TABLE else [zstd])],
        "fill_value": 0,
        "dimension_names": dimension_names(array),
        "attributes": {},
        "storage_transformers": [],
    }
