"""Many files as one .zip, made while it is sent: nothing of it lies on disk, and no file wholly in memory."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from pathlib import Path

from storage import place

BLOCK_BYTES = 1 << 18


def zipped(files: list[tuple[str, Path]]) -> Iterator[bytes]:
    """The archive's bytes in blocks. Files are stored as they are, for what a job makes is compressed already; a file
    that is gone by then is left out. The same files make the same bytes."""
    sink = _Sink()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED) as archive:  # type: ignore[call-overload]
        for name, path in files:
            try:
                source = open(place.here(path), "rb")
            except FileNotFoundError:
                continue
            entry = zipfile.ZipInfo(name)
            entry.external_attr = 0o644 << 16
            with source, archive.open(entry, "w", force_zip64=True) as target:
                while block := source.read(BLOCK_BYTES):
                    target.write(block)
                    yield sink.taken()
    yield sink.taken()


class _Sink:
    """A file that can only be written on, as a connection."""

    def __init__(self) -> None:
        self._blocks: list[bytes] = []

    def write(self, block: bytes) -> int:
        self._blocks.append(bytes(block))
        return len(block)

    def flush(self) -> None:
        pass

    def taken(self) -> bytes:
        taken, self._blocks = b"".join(self._blocks), []
        return taken
