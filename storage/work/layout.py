"""What describes an array of a stage's folder: the content of its `zarr.json`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

BLOCK = 16384  # splats a task: two groups
METADATA = "zarr.json"


@dataclass(frozen=True)
class Layout:
    """What an array's `zarr.json` says."""

    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dtype: np.dtype

    @property
    def of_whole_rows(self) -> bool:
        return self.chunks[1:] == self.shape[1:]

    def to_json(self) -> dict:
        """As zarr writes it. Chunks are files c.0.0: its usual c/0/0 is a new folder a chunk, which takes longer than
        most bytes."""
        codec = {"name": "bytes"} | ({"configuration": {"endian": "little"}} if self.dtype.itemsize > 1 else {})
        return {
            "shape": list(self.shape),
            "data_type": self.dtype.name,
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": list(self.chunks)}},
            "chunk_key_encoding": {"name": "default", "configuration": {"separator": "."}},
            "fill_value": self.dtype.type(0).item(),
            "codecs": [codec],
            "attributes": {},
            "zarr_format": 3,
            "node_type": "array",
            "storage_transformers": [],
        }


def layout_for(shape: tuple[int, ...], dtype: str, chunks: tuple[int, ...] | None) -> Layout:
    """Of an array in chunks of these rows, by default BLOCK, or as many as it has."""
    return Layout(
        tuple(shape), tuple(max(1, min(c, s)) for c, s in zip(chunks or (BLOCK, *shape[1:]), shape)), np.dtype(dtype)
    )
