"""The files of a scan that is a folder or a .zip, named by their path inside it.

`Folder` and `Archive` answer the same four questions: `label`, `size`, `open`, `local`. Both are plain values, so a
source that holds one can be sent to another process. An archive is never unpacked as a whole.
"""

from __future__ import annotations

import io
import lzma
import os
import shutil
import stat
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import BinaryIO

from storage.errors import InvalidScan, UnsupportedScan

MAX_ENTRIES = 200_000
MAX_UNPACKED_BYTES = 1 << 40
MAX_RATIO = 100  # a workspace packs about 1.5 to 1, text models and .vis about 10 to 1; zip bombs start at 1000 to 1

_BLOCK_BYTES = 1 << 20
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
_DAMAGE = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError)


def escapes(name: str) -> bool:
    """True for a member name that could point outside the scan: absolute, with "..", a drive or a backslash."""
    parts = name.split("/")
    return not name or name.startswith("/") or ".." in parts or any(c in name for c in "\\:\0")


@dataclass(frozen=True)
class Folder:
    path: str

    def label(self, name: str) -> str:
        return os.path.join(self.path, name)

    def size(self, name: str) -> int | None:
        """Bytes of the file, or None where there is none."""
        path = self.label(name)
        return os.path.getsize(path) if os.path.isfile(path) else None

    @contextmanager
    def open(self, name: str) -> Iterator[BinaryIO]:
        with open(self.label(name), "rb") as stream:
            yield stream

    @contextmanager
    def local(self, name: str, max_bytes: int | None = None) -> Iterator[str]:
        """A path on disk that holds the file, or at least its first `max_bytes`."""
        yield self.label(name)


@dataclass(frozen=True)
class Archive:
    path: str
    root: str  # the folder inside that wraps everything, with its "/", or ""
    sizes: dict[str, int]  # unpacked bytes by member name below the root

    def label(self, name: str) -> str:
        return f"{self.path}/{self.root}{name}"

    def size(self, name: str) -> int | None:
        return self.sizes.get(name)

    @contextmanager
    def open(self, name: str) -> Iterator[BinaryIO]:
        try:
            with zipfile.ZipFile(self.path) as archive, archive.open(self.root + name) as member:
                yield io.BufferedReader(member, _BLOCK_BYTES)
        except _DAMAGE as error:
            raise InvalidScan(self.label(name), f"damaged inside the archive ({error})", "a whole .zip") from error

    @contextmanager
    def local(self, name: str, max_bytes: int | None = None) -> Iterator[str]:
        with tempfile.TemporaryDirectory(prefix="splatpress-") as folder:
            path = os.path.join(folder, "member" + PurePosixPath(name).suffix)
            with self.open(name) as source, open(path, "wb") as target:
                if max_bytes is None:
                    shutil.copyfileobj(source, target, _BLOCK_BYTES)
                else:
                    target.write(source.read(max_bytes))
            yield path


Members = Folder | Archive


def _check_entry(path: str, entry: zipfile.ZipInfo) -> None:
    name = entry.filename
    if escapes(name):
        raise InvalidScan(f"{path}:{name!r}", "a name that leaves the archive", "relative names without '..' or '\\'")
    if stat.S_ISLNK(entry.external_attr >> 16):
        raise InvalidScan(f"{path}:{name}", "a symbolic link", "plain files and folders")
    if entry.flag_bits & 1:
        raise UnsupportedScan(f"{path}:{name}", "an encrypted member", "archives without a password")
    if entry.compress_type not in _METHODS:
        raise UnsupportedScan(f"{path}:{name}", f"compression method {entry.compress_type}", f"methods {_METHODS}")


def _check_sizes(path: str, entries: list[zipfile.ZipInfo]) -> None:
    packed, unpacked = sum(e.compress_size for e in entries), sum(e.file_size for e in entries)
    archive_bytes = os.path.getsize(path)
    if len(entries) > MAX_ENTRIES:
        raise InvalidScan(path, f"{len(entries)} members", f"at most {MAX_ENTRIES}")
    if packed > archive_bytes:
        raise InvalidScan(path, f"members of {packed} packed bytes in {archive_bytes}", "members that do not overlap")
    if unpacked > min(MAX_UNPACKED_BYTES, MAX_RATIO * archive_bytes):
        allowed = f"at most {MAX_RATIO} to 1 and {MAX_UNPACKED_BYTES} bytes"
        raise InvalidScan(path, f"{unpacked} bytes unpacked from {archive_bytes}", allowed)


def _wrapping_folder(names: list[str], landmarks: tuple[str, ...]) -> str:
    """The one top folder that holds everything, where no landmark stands at the top itself."""
    tops = {name.split("/")[0] for name in names if not name.startswith("__MACOSX/")}
    return f"{tops.pop()}/" if len(tops) == 1 and not tops & set(landmarks) else ""


def open_archive(path: str, landmarks: tuple[str, ...]) -> Archive:
    """An archive whose list of members has been checked; `landmarks` are names that mark the top of the scan.

    Raises: InvalidScan for names that escape, links, duplicates, overlaps and bombs; UnsupportedScan for encryption.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
    except _DAMAGE as error:
        raise InvalidScan(path, f"not a whole .zip ({error})", "a .zip archive") from error
    _check_sizes(path, entries)
    seen: set[str] = set()
    for entry in entries:
        _check_entry(path, entry)
        if entry.filename in seen:
            raise InvalidScan(f"{path}:{entry.filename}", "a name that occurs twice", "every name once")
        seen.add(entry.filename)
    files = {e.filename: e.file_size for e in entries if not e.is_dir()}
    root = _wrapping_folder(list(files), landmarks)
    return Archive(path, root, {n[len(root) :]: size for n, size in files.items() if n.startswith(root)})
