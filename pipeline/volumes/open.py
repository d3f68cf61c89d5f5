"""Which reader a volume belongs to."""

from __future__ import annotations

import errno
import os
from importlib import import_module
from pathlib import Path

from pipeline.volumes.volume import Choice, Volume
from storage import place
from storage.errors import UnsupportedScan
from storage.foreign import is_store

# Modules are imported when first needed: each pulls in a library of its own.
_READERS = {
    ".nrrd": ("nrrd", "open_nrrd"),
    ".nhdr": ("nrrd", "open_nrrd"),
    ".nii": ("nifti", "open_nifti"),
    ".nii.gz": ("nifti", "open_nifti"),
    ".nii.bz2": ("nifti", "open_nifti"),
    ".hdr": ("nifti", "open_nifti"),
    ".tif": ("tiff", "open_tiff"),
    ".tiff": ("tiff", "open_tiff"),
    ".mha": ("metaimage", "open_metaimage"),
    ".mhd": ("metaimage", "open_metaimage"),
    ".raw": ("raw", "open_raw"),
    ".dcm": ("dicom", "open_dicom"),
}
LOOKED_AT = 32  # files of a folder, to tell whether it is a DICOM series
HANDLED = "NRRD (.nrrd, .nhdr), NIfTI (.nii, .nii.gz), MetaImage (.mha, .mhd), TIFF (one file of pages, or a folder of files), DICOM (a folder of a series), OME-Zarr or zarr (folder), .raw with a .json beside it"


def _reader(path: Path) -> tuple[str, str] | None:
    if path.is_dir():
        if is_store(path):
            return "ome_zarr", "open_ome_zarr"
        if not (path / "sparse").is_dir() and any(p.suffix.lower() in (".tif", ".tiff") for p in path.iterdir()):
            return "tiff", "open_tiff"
        return ("dicom", "open_dicom") if _has_dicom(path) else None
    name = path.name.lower()
    return next((reader for suffix, reader in _READERS.items() if name.endswith(suffix)), None)


def _has_dicom(folder: Path) -> bool:
    """By the first bytes of its first files, without pydicom: folders of scans are looked at too."""
    files = sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
    return any(_begins_as_dicom(file) for file in files[:LOOKED_AT])


def _begins_as_dicom(file: Path) -> bool:
    with open(file, "rb") as opened:
        return opened.read(132)[128:] == b"DICM"


def volume_suffixes() -> tuple[str, ...]:
    """Of the single files that some reader takes."""
    return tuple(_READERS)


def is_volume(path: str | os.PathLike) -> bool:
    """Whether a path is taken for a volume: by its name, of a folder by what lies in it."""
    return _reader(Path(path)) is not None


def open_volume(path: str | os.PathLike, choice: Choice = Choice()) -> Volume:
    """Opens a volume by its header.

    Guarantees: voxels are not read; the volume can be pickled, and its slices read any number of times, each time in one pass.
    Raises: FileNotFoundError where there is nothing; InvalidScan for a file that breaks its format; UnsupportedScan for a format, or a
    sort of voxels, that is not handled.
    """
    path = place.held(Path(path))
    if not path.exists():
        raise FileNotFoundError(errno.ENOENT, "no such volume", str(path))
    reader = _reader(path)
    if reader is None:
        raise UnsupportedScan(str(path), f"a file of type {path.suffix!r}", HANDLED)
    return getattr(import_module(f"pipeline.volumes.formats.{reader[0]}"), reader[1])(str(path), choice)
