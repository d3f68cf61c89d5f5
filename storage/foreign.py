"""Zarr stores of others, opened to be read."""

from __future__ import annotations

from pathlib import Path

import zarr

from storage import zarr_config  # noqa: F401 (for its effect)
from storage.errors import InvalidScan

MARKS = ("zarr.json", ".zgroup", ".zarray")


def is_store(folder: Path) -> bool:
    """Whether a folder is a zarr store, by the file that describes it."""
    return any((folder / mark).is_file() for mark in MARKS)


def open_store(path: str) -> zarr.Array | zarr.Group:
    """Raises InvalidScan for what zarr cannot read."""
    try:
        return zarr.open(path, mode="r")
    except Exception as error:  # zarr raises many kinds
        found = f"not readable as zarr ({type(error).__name__}: {str(error)[:200]})"
        raise InvalidScan(path, found, "a zarr group or array") from error
