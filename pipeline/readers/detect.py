"""Which reader a path belongs to."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from pipeline.scan import ScanSource
from storage.errors import InvalidScan, UnsupportedScan

# Modules are imported when first needed: each pulls in a library of its own, and inspect has to be quick.
_READERS = {
    ".zip": ("colmap.workspace", "open_colmap"),
    ".ply": ("ply.ply", "open_ply"),
    ".las": ("las.las", "open_las"),
    ".laz": ("las.las", "open_las"),
    ".e57": ("e57.e57", "open_e57"),
}
_HANDLED = "a COLMAP dense workspace (folder or .zip), .ply, .las, .laz, .e57"
_VOLUMES = (".mha", ".mhd", ".vti", ".slc", ".dcm")
_HINTS = {
    **dict.fromkeys(_VOLUMES, "write the volume as .nrrd or .nii"),
    **dict.fromkeys((".pcd", ".pts", ".ptx", ".xyz", ".txt"), "convert it to .ply or .e57"),
    **dict.fromkeys((".obj", ".stl", ".glb", ".gltf"), "meshes are not handled; sample points into a .ply"),
}


def handled_suffixes() -> tuple[str, ...]:
    """Of the files that some reader takes."""
    return tuple(_READERS)


def _reader(path: Path) -> Callable[[str], ScanSource]:
    suffix = path.suffix.lower()
    if path.is_dir():
        module, function = _READERS[".zip"]
    elif suffix in _READERS and path.is_file():
        module, function = _READERS[suffix]
    else:
        found = f"a file of type {suffix!r}" if path.is_file() else "neither a file nor a folder"
        raise UnsupportedScan(str(path), found, _HANDLED, _HINTS.get(suffix, ""))
    return getattr(import_module(f"pipeline.readers.{module}"), function)


def open_scan(path: str | os.PathLike) -> ScanSource:
    """Opens a scan of any handled format by its header.

    Guarantees: points and pixels are not read; the source can be pickled, and its pieces read any number of times.
    Raises: FileNotFoundError where there is nothing at `path`; InvalidScan for a scan that breaks its format or has no
    points; UnsupportedScan for a format that is not handled.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(errno.ENOENT, "no such scan", str(path))
    source = _reader(path)(str(path))
    if source.n_points == 0:
        raise InvalidScan(str(path), "an empty scan, 0 points", "at least one point")
    return source
