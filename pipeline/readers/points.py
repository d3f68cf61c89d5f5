"""Which reader a file of points belongs to, by its suffix."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module

import numpy as np

from pipeline.readers.attributes.looks import Looks
from pipeline.readers.attributes.options import ReadOptions
from pipeline.readers.files.spelling import plain_path, shown
from pipeline.readers.guard.guard import call, guarded
from pipeline.scan import Piece, ScanSource
from storage.errors import InvalidScan, UnsupportedScan
from storage.packed.seal import SUFFIX

# Modules are imported when first needed: each pulls in a library of its own, and inspect has to be quick.
READERS = {
    ".ply": ("ply.ply", "open_ply"),
    ".las": ("las.las", "open_las"),
    ".laz": ("las.las", "open_las"),
    ".e57": ("e57.e57", "open_e57"),
    ".ptx": ("text.ptx", "open_ptx"),
    ".pcd": ("pcd.pcd", "open_pcd"),
    **dict.fromkeys((".xyz", ".pts", ".txt", ".asc", ".csv"), ("text.table", "open_table")),
}
HANDLED = f"a COLMAP dense workspace (folder or .zip), {', '.join(READERS)}"
_VOLUMES = (".vti", ".slc", ".dcm")
_POINT_FORMAT_AT, _PACKED = 104, 0xC0  # in a LAS header
_MAGIC = {
    b"\x1f\x8b": "gzip",
    b"PK\x03\x04": "a .zip",
    b"7z\xbc\xaf": "7-Zip",
    b"Rar!": "RAR",
    b"\x28\xb5\x2f\xfd": "Zstandard",
    b"BZh": "bzip2",
}
_HINTS = {
    **dict.fromkeys(
        (".gz", ".7z", ".rar", ".tar", ".bz2", ".xz", ".zst", ".tgz"), "unpack it first, or make a .zip of it"
    ),
    **dict.fromkeys(
        (".rcp", ".rcs", ".fls", ".fws", ".zfs", ".zfprj", ".lsproj", ".pod", ".rxp"),
        "export it as .e57 from the scanner's program",
    ),
    **dict.fromkeys(
        (".splat", ".spz", ".ksplat", ".sog"), "Gaussians are no scan; give the points that they were made from"
    ),
    SUFFIX: "a packed file is no scan; `inspect`, `render`, `view` and `export` read it",
    **dict.fromkeys((".psx", ".mvs", ".nvm", ".out", ".rcproj"), "export photographs and points as a COLMAP workspace"),
    **dict.fromkeys(_VOLUMES, "write the volume as .nrrd or .nii"),
    **dict.fromkeys((".obj", ".stl", ".glb", ".gltf"), "meshes are not handled; sample points into a .ply"),
}


def open_points(path: str, options: ReadOptions, called: str | None = None) -> ScanSource:
    """The scan in a file of points; `called` is its name for people, and in what it says.

    Raises: InvalidScan, UnsupportedScan.
    """
    suffix = os.path.splitext(path)[1].lower()
    called = called or shown(path)
    if suffix not in READERS:
        raise UnsupportedScan(called, f"a file of type {shown(suffix)!r}", HANDLED, _HINTS.get(suffix, ""))
    if path == called and shown(path) == path:
        return _open(path, options)
    return opened_anew(partial(plain_path, path), called, options)


def _open(path: str, options: ReadOptions) -> ScanSource:
    suffix = os.path.splitext(path)[1].lower()
    if _may_crash(path, suffix):
        return guarded(call(path, _open_here, path, suffix, options))
    return _open_here(path, suffix, options)


def _open_here(path: str, suffix: str, options: ReadOptions) -> ScanSource:
    with open(path, "rb") as stream:
        begins = stream.read(4)
    for magic, packed in _MAGIC.items():
        if begins.startswith(magic):
            raise InvalidScan(
                path, f"packed by {packed}, whatever its name says", f"a {suffix} file", "unpack it first"
            )
    module, function = READERS[suffix]
    return getattr(import_module(f"pipeline.readers.{module}"), function)(path, options)


def _may_crash(path: str, suffix: str) -> bool:
    """Whether a library parses the file that ends its process on some broken bytes: E57, and LAS that is packed."""
    if suffix not in (".las", ".laz"):
        return suffix == ".e57"
    with open(path, "rb") as stream:
        stream.seek(_POINT_FORMAT_AT)
        return (stream.read(1) or b"\0")[0] & _PACKED != 0


@dataclass(frozen=True)
class _Anew:
    """A file of points that is put under a path which libraries take whenever it is read, and is left nowhere."""

    local: Callable[[], AbstractContextManager[str]]
    called: str
    options: ReadOptions
    looks: Looks | None = None  # of all points, where they are not as sampled

    def opened(self, path: str) -> ScanSource:
        source = _open(path, self.options)
        settled = source.settle(self.looks) if self.looks and source.settle else None
        return settled or source

    def pieces(self, max_points: int) -> Iterator[Piece]:
        with self.local() as path:
            yield from self.opened(path).pieces(max_points)

    def photo(self, i: int) -> np.ndarray:
        with self.local() as path:
            return self.opened(path).read_photo(i)

    def source(self) -> ScanSource:
        with self.local() as path:
            try:
                source = self.opened(path)
            except (InvalidScan, UnsupportedScan) as error:
                where = error.where.replace(path, self.called)
                raise type(error)(where, error.found, error.allowed, error.hint) from error
        return replace(
            source,
            path=self.called,
            pieces=self.pieces,
            read_slice=None,
            settle=self.settle if source.settle else None,
            read_photo=source.read_photo and self.photo,
            warnings=tuple(w.replace(path, self.called) for w in source.warnings),
        )

    def settle(self, looks: Looks) -> ScanSource | None:
        with self.local() as path:
            as_all = self.opened(path).settle(looks)
        return None if as_all is None else replace(self, looks=looks).source()


def opened_anew(local: Callable[[], AbstractContextManager[str]], called: str, options: ReadOptions) -> ScanSource:
    """The scan in a file that `local` puts under a path for as long as it is open; `called` is its name for people."""
    return _Anew(local, called, options).source()
