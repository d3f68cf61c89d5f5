"""The photographs of a workspace: found by their names, however these are spelled, and checked by their headers.

One that is missing, cut off or of another size is left out, named in a warning; its camera goes with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.readers.colmap.library import pycolmap
from pipeline.readers.colmap.model import RegisteredPhoto
from pipeline.readers.files.members import Members
from pipeline.readers.files.spelling import composed, shown
from pipeline.readers.photos import decode_photo, photo_size
from pipeline.scan import Camera
from storage.errors import InvalidScan, UnsupportedScan

FOLDERS = ("images/", "")  # of photographs, below the workspace
PINHOLE = ("PINHOLE", "SIMPLE_PINHOLE")
NAMED = 5  # photographs that a warning names of those that are left out

_HEAD_BYTES = 1 << 18  # enough for the headers of a JPEG with EXIF and thumbnail
_TAIL_BYTES = 1 << 16
_ENDS = {".jpg": b"\xff\xd9", ".jpeg": b"\xff\xd9", ".png": b"IEND"}


@dataclass(frozen=True)
class PhotoFile:
    """A registered photo, the file that holds it, and its place in the model, which visibility lists count in."""

    photo: RegisteredPhoto
    member: str
    place: int


@dataclass(frozen=True)
class Photos:
    """The photographs of a workspace that are there, a camera each, and what is to be said of the others."""

    files: tuple[PhotoFile, ...]
    cameras: tuple[Camera, ...]
    warnings: tuple[str, ...]


def find_photos(members: Members, photos: tuple[RegisteredPhoto, ...]) -> Photos:
    """The photos that are there, and pinhole cameras for them.

    Raises: InvalidScan where none is, or where a name fits several files; UnsupportedScan for a camera model.
    """
    files, cameras, left_out, spelled = [], [], [], []
    pinholes: dict[int, pycolmap.Camera] = {}
    for place, photo in enumerate(photos):
        try:
            member = _find(members, photo)
            _check(members, photo, member)
        except (_Absent, InvalidScan) as error:
            left_out.append(error)
            continue
        if composed(member).rpartition("/")[2] != composed(photo.name.replace("\\", "/")).rpartition("/")[2]:
            spelled.append(f"{shown(photo.name)!r} is {shown(member)!r}")
        if photo.camera_id not in pinholes:
            pinholes[photo.camera_id] = _undistorted(photo, members.label(f"camera {photo.camera_id}"))
        files.append(PhotoFile(photo, member, place))
        cameras.append(_camera(photo, pinholes[photo.camera_id]))
    if not files:
        raise InvalidScan(left_out[0].where, left_out[0].found, left_out[0].allowed, _of_all(len(photos)))
    warnings = []
    if left_out:
        named = "; ".join(f"{e.where}: {e.found}" for e in left_out[:NAMED])
        more = f"; and {len(left_out) - NAMED} more" if len(left_out) > NAMED else ""
        warnings.append(f"{len(left_out)} of {len(photos)} registered photographs are left out: {named}{more}")
    if spelled:
        more = f", and {len(spelled) - NAMED} more" if len(spelled) > NAMED else ""
        warnings.append(f"photographs are spelled otherwise than in the model: {', '.join(spelled[:NAMED])}{more}")
    return Photos(tuple(files), tuple(cameras), tuple(warnings))


def read_photo(members: Members, files: tuple[PhotoFile, ...], i: int) -> np.ndarray:  # (height, width, 3)
    """Photo i as uint8 sRGB, undistorted."""
    photo, name = files[i].photo, files[i].member
    where = shown(members.label(name))
    if not members.size(name):
        raise _empty(members, name)
    with members.local(name) as path:
        pixels = decode_photo(path, where)
    _check_size(photo, where, pixels.shape[1], pixels.shape[0])  # it may have changed since the scan was opened
    if photo.model in PINHOLE:
        return pixels
    options, bitmap = pycolmap.UndistortCameraOptions(), pycolmap.Bitmap.from_array(pixels)
    return pycolmap.undistort_image(options, bitmap, photo.camera)[0].to_array()


class _Absent(InvalidScan):
    """There is no such file."""


def _of_all(n: int) -> str:
    return f"none of the {n} registered photographs can be used"


def _registered_with(photo: RegisteredPhoto) -> str:
    return f"camera {photo.camera_id} of {photo.width_px}x{photo.height_px} pixels"


def _find(members: Members, photo: RegisteredPhoto) -> str:
    """The file of a photo: in images/ or beside it, in any spelling, else by the end of its path."""
    for folder in FOLDERS:
        if found := members.names.find(folder + photo.name):
            break
    else:
        found = members.names.find_ending(photo.name)
    where = shown(members.label(FOLDERS[0] + photo.name))
    if len(found) > 1:
        several = " and ".join(repr(shown(n)) for n in found[:4])
        raise InvalidScan(where, f"{several} both fit", "one file for a photo")
    if not found:
        what = f"missing, though registered with {_registered_with(photo)}"
        raise _Absent(where, what, "every registered photo in images/")
    return found[0]


def _check(members: Members, photo: RegisteredPhoto, name: str) -> None:
    where = shown(members.label(name))
    if not members.size(name):
        raise _empty(members, name)
    _check_size(photo, where, *_header_size(members, name))
    end = _ENDS.get("." + name.lower().rpartition(".")[2])
    tail = members.tail(name, _TAIL_BYTES) if end else None
    if tail is not None and end not in tail:
        raise InvalidScan(where, "a photo that is cut off", "a whole JPEG or PNG")


def _empty(members: Members, name: str) -> InvalidScan:
    found = "an empty file, or none" if members.size(name) is None else "0 bytes"
    return InvalidScan(shown(members.label(name)), found, "a photo")


def _check_size(photo: RegisteredPhoto, where: str, width: int, height: int) -> None:
    if (width, height) != (photo.width_px, photo.height_px):
        found = f"a photo of {width}x{height} pixels, registered with {_registered_with(photo)}"
        raise InvalidScan(where, found, "the same size")


def _header_size(members: Members, name: str) -> tuple[int, int]:
    """Width and height of a photo, from its first bytes where they tell, else from the whole file."""
    where, n_bytes = shown(members.label(name)), members.size(name)
    try:
        with members.local(name, _HEAD_BYTES) as path:
            return photo_size(path, where)
    except InvalidScan:
        if n_bytes <= _HEAD_BYTES:
            raise
    with members.local(name) as path:  # a header longer than that, or at the end, as TIFF may have it
        return photo_size(path, where)


def _undistorted(photo: RegisteredPhoto, where: str) -> pycolmap.Camera:
    """The pinhole camera that stands for the photo's own."""
    if photo.model in PINHOLE:
        return photo.camera
    try:
        return pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), photo.camera)
    except (ValueError, RuntimeError) as error:
        hint = "make pinhole photographs of it first"
        raise UnsupportedScan(where, f"camera model {photo.model}", "models that COLMAP undistorts", hint) from error


def _camera(photo: RegisteredPhoto, pinhole: pycolmap.Camera) -> Camera:
    k = pinhole.calibration_matrix()
    return Camera(
        name=shown(photo.name),
        width_px=int(pinhole.width),
        height_px=int(pinhole.height),
        fx_px=float(k[0, 0]),
        fy_px=float(k[1, 1]),
        cx_px=float(k[0, 2]),
        cy_px=float(k[1, 2]),
        rotation=photo.rotation,
        centre=photo.centre,
    )
