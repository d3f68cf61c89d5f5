"""Volumes as uploads: which files are taken, and what is looked at before one becomes a scan.

A job finds one file under a name of the service's, so whatever points at another file (a detached NRRD header, OME
metadata of several files) is refused before a reader follows it: it would name files of this machine.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from pipeline.readers.detect import handled_suffixes
from services.problems import Problem

VOLUMES = (".nrrd", ".nii", ".nii.gz", ".nii.bz2", ".mha", ".tif", ".tiff")  # whole in one file
SMALL_BYTES = 4 << 30  # unpacked; up to there any ratio is allowed: names of regions pack to a thousandth
LINE_BYTES = 1 << 16  # as the reader reads a header
_ELSEWHERE = re.compile(rb"\s*data\s*file\s*:", re.IGNORECASE)


def taken_suffixes() -> tuple[str, ...]:
    """Of the files that the service takes."""
    return (*handled_suffixes(), *VOLUMES)


def taken_suffix(file: str) -> str:
    """The suffix by which a file is read; of what is not taken the last one.

    >>> taken_suffix("Head.NII.gz"), taken_suffix("a.b.ply"), taken_suffix("a.exe")
    ('.nii.gz', '.ply', '.exe')
    """
    found = [suffix for suffix in VOLUMES if file.lower().endswith(suffix)]
    return max(found, key=len) if found else Path(file).suffix.lower()


def check_name(file: str, what: str = "") -> None:
    """Raises Problem 415 for a file that is not taken."""
    if taken_suffix(file) not in taken_suffixes():
        raise Problem(415, "unsupported-scan", f"{what}{file!r}; allowed: {', '.join(taken_suffixes())}")


def volume_header(path: Path, limits: dict) -> dict:
    """What `inspect` says of a volume, and the fields of every scan.

    Raises: Problem 422 for voxels elsewhere or beyond a limit; what `open_volume` and reading a slice raise.
    """
    from pipeline.volumes.inspect import summarise_volume
    from pipeline.volumes.open import open_volume
    from pipeline.volumes.volume import Choice
    from storage.errors import UnsupportedScan

    _check_alone(path)
    volume = open_volume(path, Choice(component=0, time=0))  # a job says which
    if volume.files != (str(path),):
        raise _elsewhere(path.name, "its voxels")
    _check_size(path, volume, limits)
    np.isfinite(next(iter(volume.slices(lambda text: None)))).any()
    header = summarise_volume(volume)
    try:
        open_volume(path)
    except UnsupportedScan as error:
        header["warnings"].append(f"{error}: {error.hint}".replace("--", "option ") if error.hint else str(error))
    corners = np.array([header["first_voxel"], header["last_voxel"]])
    return {
        **header,
        "points": None,  # as many as an iso value gives
        "bounds": {"min": corners.min(axis=0).tolist(), "max": corners.max(axis=0).tolist()},
        "cameras": {"count": 0, "sizes": {}, "models": {}, "names": []},
        "stations": [],
        "has_normals": True,
        "has_colors": False,
        "has_intensity": False,
        "has_visibility": False,
        "lacks": [],
        "unused_properties": [],
    }


def _elsewhere(name: str, what: str) -> Problem:
    return Problem(422, "bad-scan", f"{name}: {what} in another file; allowed: a volume that is whole in one file")


def _check_alone(path: Path) -> None:
    suffix = taken_suffix(path.name)
    if suffix == ".nrrd":
        with open(path, "rb") as file:
            while (line := file.readline(LINE_BYTES)).strip():
                if _ELSEWHERE.match(line):
                    raise _elsewhere(path.name, "a header whose voxels lie")
    if suffix == ".mha" and not _is_local(path):
        raise _elsewhere(path.name, "a header whose voxels lie")
    if suffix in (".tif", ".tiff"):
        _check_ome(path)


def _is_local(path: Path) -> bool:
    """Whether the voxels of a MetaImage stand after its header; also where the reader refuses that."""
    from pipeline.volumes.formats.metaimage import MAX_LINE_BYTES

    with open(path, "rb") as file:
        while b"=" in (line := file.readline(MAX_LINE_BYTES)):
            name, _, value = line.decode("utf-8", "replace").partition("=")
            if name.strip().lower() == "elementdatafile":
                return value.strip().upper() == "LOCAL"
    return True


def _check_ome(path: Path) -> None:
    """tifffile reads every file that OME metadata name: their ids must all be this file's own."""
    import tifffile

    from storage.errors import InvalidScan

    try:
        with tifffile.TiffFile(path) as tif:  # reads no metadata of series
            text = tif.ome_metadata
        root = ElementTree.fromstring(text) if text else ElementTree.Element("none")
    except MemoryError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno:
            raise
        found = "cannot be read"
        raise InvalidScan(path.name, found, "a whole TIFF file", "it may be truncated") from error
    own = root.get("UUID")
    if any(e.tag.endswith("BinaryOnly") or (e.tag.endswith("UUID") and e.text != own) for e in root.iter()):
        raise _elsewhere(path.name, "OME metadata that place voxels")


def _check_size(path: Path, volume, limits: dict) -> None:
    n_voxels = int(np.prod(volume.shape, dtype=object))
    unpacked, n_slice = n_voxels * volume.dtype.itemsize, volume.shape[0] * volume.shape[1]
    ratio = unpacked / max(1, path.stat().st_size)
    for found, allowed, what in (
        (n_slice, limits["max_photo_pixels"], "voxels a slice"),
        (unpacked, limits["max_unpacked_bytes"], "bytes of voxels"),
        (ratio if unpacked > SMALL_BYTES else 0, limits["max_archive_ratio"], "bytes of voxels for one of the file"),
    ):
        if found > allowed:
            raise Problem(
                422, "archive-too-large", f"{path.name}: {found:,.0f} {what}; allowed: at most {allowed:,.0f}"
            )
