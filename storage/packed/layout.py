"""Where each array's bytes lie: its zarr chunks, the members of the zip that hold them, and its zarr.json.

All of it follows from the header and the lengths of the word streams, so a reader never takes a file's word for it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from storage.packed.batches import CHUNKS_PER_GROUP
from storage.packed.schema import GROUP, Array, Header, dimensions_of

GROUPS_PER_ZARR_CHUNK = 8  # 65,536 splats: the pack tasks own whole zarr chunks
WORDS_PER_ZARR_CHUNK = 1 << 16
RUNS_PER_ZARR_CHUNK = 1 << 16
STEPS_PER_ZARR_CHUNK = 1 << 19
ATOMS_PER_ZARR_CHUNK = 256
ZSTD_LEVEL = 9
ROOT_MEMBER = "zarr.json"


def shape_of(header: Header, array: Array, n_words: int = 0) -> tuple[int, ...]:
    """The shape of an array; `n_words` is the length of a word stream, spare word included."""
    sizes = dimensions_of(header) | {"e": n_words}
    return tuple(sizes[d] for d in array.dims)


def chunk_shape(array: Array, shape: tuple[int, ...]) -> tuple[int, ...]:
    """The shape of an array's zarr chunks: whole rows, so many that no chunk is larger than a megabyte."""
    rows = {
        "n": GROUP * GROUPS_PER_ZARR_CHUNK,
        "c": CHUNKS_PER_GROUP * GROUPS_PER_ZARR_CHUNK,
        "e": WORDS_PER_ZARR_CHUNK,
        **dict.fromkeys("qm", RUNS_PER_ZARR_CHUNK),
        "t": STEPS_PER_ZARR_CHUNK,
        "k": ATOMS_PER_ZARR_CHUNK,
    }.get(array.dims[0], shape[0])
    return tuple(max(1, c) for c in (min(rows, shape[0]), *shape[1:]))


def chunk_count(array: Array, shape: tuple[int, ...]) -> int:
    return -(-shape[0] // chunk_shape(array, shape)[0])


def chunk_member(array: Array, index: int) -> str:
    """The zip's member that holds zarr chunk `index` along the first axis, the only one that is split."""
    return f"{array.name}/c/{index}" + "/0" * (len(array.dims) - 1)


def metadata_member(array: Array) -> str:
    return f"{array.name}/{ROOT_MEMBER}"


def members_of(array: Array, shape: tuple[int, ...]) -> Iterator[str]:
    """All members of the zip that an array has."""
    yield metadata_member(array)
    for index in range(chunk_count(array, shape)):
        yield chunk_member(array, index)


def chunk_bytes(array: Array, shape: tuple[int, ...]) -> int:
    """Bytes of a zarr chunk when decompressed; the last one is as long as the others."""
    return int(np.prod(chunk_shape(array, shape))) * np.dtype(array.dtype).itemsize


def dimension_names(array: Array) -> list[str | None]:
    """Of dimensions with a name; one of a fixed size has none, for some readers want all names to differ (32 x 32 texels)."""
    return [None if dim.isdigit() else dim for dim in array.dims]


def metadata_of(array: Array, shape: tuple[int, ...]) -> dict:
    """What an array's zarr.json says, word for word."""
    little = {"configuration": {"endian": "little"}} if np.dtype(array.dtype).itemsize > 1 else {}
    return {
        "zarr_format": 3,
        "node_type": "array",
        "shape": list(shape),
        "data_type": array.dtype,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": list(chunk_shape(array, shape))}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "codecs": [
            {"name": "bytes", **little},
            {"name": "zstd", "configuration": {"level": ZSTD_LEVEL, "checksum": False}},
        ],
        "fill_value": 0,
        "dimension_names": dimension_names(array),
        "attributes": {},
        "storage_transformers": [],
    }
