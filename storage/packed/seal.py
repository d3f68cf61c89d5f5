"""The seal of a packed file: the zip's comment is the SHA-256 of all bytes before it.

So any truncated or altered file is refused before a single field of it is believed.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import BinaryIO

from storage.errors import InvalidPackedFile

SEAL = b"splatpress sha256 "
SEAL_BYTES = len(SEAL) + 64
SUFFIX = ".splatpress"
MADE_BY = "a scan becomes one by `compress`"
_WHOLE = f"a whole packed file, NAME{SUFFIX}"
_ZIP = b"PK\3\4"


def end_with_seal(file: BinaryIO, digest: str) -> None:
    """End a file, of whose bytes this is the SHA-256, by its seal, and wait until the disk has it."""
    file.write(SEAL + digest.encode())
    file.flush()
    os.fsync(file.fileno())


def check_seal(path: Path) -> None:
    """Raise InvalidPackedFile unless the file ends in the seal of the bytes before it."""
    if path.is_dir():
        raise InvalidPackedFile(str(path), "a folder", _WHOLE, MADE_BY)
    with open(path, "rb") as file:
        begins = file.read(len(_ZIP))
        digest = digest_of(file, os.fstat(file.fileno()).st_size - SEAL_BYTES)
        found = file.read()
    if not found.startswith(SEAL):
        if not begins:
            raise InvalidPackedFile(str(path), "an empty file", _WHOLE, MADE_BY)
        if begins != _ZIP:
            raise InvalidPackedFile(str(path), "no packed file, which begins as a zip does", _WHOLE, MADE_BY)
        raise InvalidPackedFile(str(path), "no seal at its end", _WHOLE, "cut off or altered; " + MADE_BY)
    if found != SEAL + digest.encode():
        sealed = found[len(SEAL) :].decode("ascii", "replace")
        raise InvalidPackedFile(
            str(path), f"contents of SHA-256 {digest[:16]}...", f"what the seal says, {sealed[:16]}...", "altered"
        )


def names_packed_file(path: str | Path) -> bool:
    """Whether a path is taken for a packed file: by its name, or by its end."""
    return Path(path).suffix.lower() == SUFFIX or is_packed_file(path)


def is_packed_file(path: str | Path) -> bool:
    """Whether a file's end claims that it is a packed file; says nothing of its health."""
    path = Path(path)
    if not path.is_file() or path.stat().st_size < SEAL_BYTES:
        return False
    with open(path, "rb") as file:
        file.seek(-SEAL_BYTES, os.SEEK_END)
        return file.read(len(SEAL)) == SEAL


def digest_of(file, n_bytes: int) -> str:
    """SHA-256 of the first `n_bytes`; the file then stands right behind them."""
    file.seek(0)
    state, left = hashlib.sha256(), n_bytes
    while left > 0:
        block = file.read(min(left, 1 << 20))
        if not block:
            break
        state.update(block)
        left -= len(block)
    return state.hexdigest()
