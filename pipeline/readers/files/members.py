"""The files of a scan that is a folder or a .zip, named by their path inside it.

`Folder` and `Archive` answer the same questions: `names`, `below`, `label`, `size`, `open`, `local`, `tail`. Both are plain values, so a
source that holds one can be sent to another process. An archive is never unpacked as a whole.
"""

from __future__ import annotations

import errno
import io
import lzma
import os
import re
import shutil
import stat
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import PurePosixPath
from typing import BinaryIO

from pipeline.readers.files.spelling import JUNK_FOLDERS, Names, is_junk, name_of, plain_path, shown
from storage.errors import InvalidScan, UnsupportedScan

MAX_ENTRIES = 200_000
MAX_UNPACKED_BYTES = 1 << 40
MAX_RATIO = 100  # a workspace packs about 1.5 to 1, text models and .vis about 10 to 1; zip bombs start at 1000 to 1

_BLOCK_BYTES = 1 << 20
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
_DRIVE = re.compile(r"[A-Za-z]:/")
_DAMAGE = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, NotImplementedError, ValueError, struct.error)


def escapes(name: str) -> bool:
    """True for a name that could point outside the scan: absolute, with "..", or with a drive."""
    name = name.replace("\\", "/")
    return not name or name.startswith("/") or ".." in name.split("/") or "\0" in name or bool(_DRIVE.match(name))


@dataclass(frozen=True)
class Folder:
    """The files below a folder, as `Archive` has those of a .zip."""

    path: str

    @cached_property
    def names(self) -> Names:
        """All files below, but those that file managers leave behind."""
        return Names.of(n for n in _files_below(self.path) if not is_junk(n))

    def below(self, root: str) -> Folder:
        """The folder `root`, which ends with "/" or is ""."""
        return Folder(os.path.join(self.path, root[:-1])) if root else self

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
        with plain_path(self.label(name)) as path:
            yield path

    def tail(self, name: str, n_bytes: int) -> bytes | None:
        """The last bytes of the file."""
        with self.open(name) as stream:
            stream.seek(0, os.SEEK_END)
            stream.seek(max(0, stream.tell() - n_bytes))
            return stream.read()


def _files_below(path: str) -> Iterator[str]:
    """Paths relative to a folder, with "/"; links to folders are not followed."""
    for folder, folders, files in os.walk(path):
        folders[:] = sorted(f for f in folders if f.lower() not in JUNK_FOLDERS)
        where = os.path.relpath(folder, path)
        prefix = "" if where == "." else where.replace(os.sep, "/") + "/"
        yield from (prefix + f for f in sorted(files))


@dataclass(frozen=True)
class Archive:
    """The files of a .zip, as `Folder` has those below a folder."""

    path: str
    root: str  # the folder inside that is looked at, with its "/", or ""
    sizes: dict[str, int]  # unpacked bytes by member name below the root
    filed_as: dict[str, str]  # how zipfile names each member

    @cached_property
    def names(self) -> Names:
        return Names.of(n for n in self.sizes if not is_junk(n))

    def below(self, root: str) -> Archive:
        inside = {n[len(root) :]: n for n in self.sizes if n.startswith(root)}
        sizes = {short: self.sizes[n] for short, n in inside.items()}
        return Archive(self.path, self.root + root, sizes, {short: self.filed_as[n] for short, n in inside.items()})

    def label(self, name: str) -> str:
        return f"{self.path}/{self.root}{name}"

    def size(self, name: str) -> int | None:
        return self.sizes.get(name)

    @contextmanager
    def open(self, name: str) -> Iterator[BinaryIO]:
        try:
            with _directory_of(self.path, _state_of(self.path)).open(self.filed_as[name]) as member:
                yield io.BufferedReader(member, _BLOCK_BYTES)  # type: ignore[type-var]
        except (*_DAMAGE, OSError) as error:
            if isinstance(error, OSError) and error.errno != errno.EINVAL:  # a place that no file has
                raise
            raise InvalidScan(
                self.label(name),
                "damaged inside the archive, or packed with a method that is not known",
                "a whole .zip",
            ) from error

    @contextmanager
    def local(self, name: str, max_bytes: int | None = None) -> Iterator[str]:
        with tempfile.TemporaryDirectory(prefix="splatpress-") as folder:
            path = os.path.join(folder, "member" + shown(PurePosixPath(name).suffix))
            with self.open(name) as source, open(path, "wb") as target:
                if max_bytes is None:
                    shutil.copyfileobj(source, target, _BLOCK_BYTES)
                else:
                    target.write(source.read(max_bytes))
            yield path

    def tail(self, name: str, n_bytes: int) -> bytes | None:
        """None: a packed member has to be unpacked to its end."""
        return None


Members = Folder | Archive


def _state_of(path: str) -> tuple[int, int, int]:
    found = os.stat(path)
    return found.st_ino, found.st_size, found.st_mtime_ns


@lru_cache(maxsize=4)
def _directory_of(path: str, state: tuple[int, int, int]) -> zipfile.ZipFile:
    """An archive with its list of members, which is read once a process: else n photographs would read n * n entries."""
    return zipfile.ZipFile(path)


def _check_entry(path: str, entry: zipfile.ZipInfo, name: str) -> None:
    if not 0 <= entry.header_offset < os.path.getsize(path):
        where = f"{path}:{shown(name)}"
        raise InvalidScan(where, f"a member at byte {entry.header_offset}", "one within the archive")
    if escapes(name):
        raise InvalidScan(f"{path}:{shown(name)!r}", "a name that leaves the archive", "relative names without '..'")
    if stat.S_ISLNK(entry.external_attr >> 16):
        raise InvalidScan(f"{path}:{shown(name)}", "a symbolic link", "plain files and folders")
    if entry.flag_bits & 1:
        raise UnsupportedScan(f"{path}:{shown(name)}", "an encrypted member", "archives without a password")
    if entry.compress_type not in _METHODS:
        raise UnsupportedScan(
            f"{path}:{shown(name)}", f"compression method {entry.compress_type}", f"methods {_METHODS}"
        )


def _name_of(entry: zipfile.ZipInfo) -> str:
    """The member's path with "/", from the bytes in the archive, which zipfile takes for cp437 unless they are marked."""
    raw = entry.filename.encode("utf-8" if entry.flag_bits & 0x800 else "cp437", "surrogateescape")
    return name_of(raw.replace(b"\\", b"/"))


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


def open_archive(path: str) -> Archive:
    """An archive whose list of members has been checked.

    Raises: InvalidScan for names that escape, links, duplicates, overlaps and bombs; UnsupportedScan for encryption.
    """
    try:
        entries = _directory_of(path, _state_of(path)).infolist()
    except _DAMAGE as error:
        raise InvalidScan(path, "not a whole .zip", "a .zip archive") from error
    _check_sizes(path, entries)
    sizes, filed_as = {}, {}
    for entry in entries:
        name = _name_of(entry)
        _check_entry(path, entry, name)
        if name in filed_as:
            raise InvalidScan(f"{path}:{shown(name)}", "a name that occurs twice", "every name once")
        filed_as[name] = entry.filename
        if not name.endswith("/"):
            sizes[name] = entry.file_size
    return Archive(path, "", sizes, {name: filed_as[name] for name in sizes})
