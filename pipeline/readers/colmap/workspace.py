"""A COLMAP dense workspace, as a folder or a .zip: `sparse/`, `images/`, `fused.ply`, `fused.ply.vis`.

Cameras stand in the order of the model's registered images. A distorted camera is replaced by the pinhole camera that
COLMAP undistorts it to, and its photo is undistorted when it is read. Without `fused.ply.vis` a scan has cameras
but no visibility.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import pycolmap

from pipeline.readers.colmap.model import RegisteredPhoto, read_model
from pipeline.readers.colmap.visibility import VisibilityStream, check_visibility
from pipeline.readers.colmap.visibility_index import visibility_from
from pipeline.readers.members import Folder, Members, open_archive
from pipeline.readers.photos import decode_photo, photo_size
from pipeline.readers.ply.ply import Vertices, open_vertices
from pipeline.scan import Camera, Piece, ScanSource
from storage.errors import InvalidScan, UnsupportedScan

_POINTS, _VISIBILITY, _PHOTOS = "fused.ply", "fused.ply.vis", "images"
_LANDMARKS = ("sparse", _PHOTOS, _POINTS)
_PINHOLE = ("PINHOLE", "SIMPLE_PINHOLE")
_PHOTO_HEAD_BYTES = 1 << 18  # enough for the headers of a JPEG with EXIF and thumbnail


def _undistorted(photo: RegisteredPhoto, where: str) -> pycolmap.Camera:
    """The pinhole camera that stands for the photo's own."""
    if photo.model in _PINHOLE:
        return photo.camera
    try:
        return pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), photo.camera)
    except (ValueError, RuntimeError) as error:
        hint = "run COLMAP's image_undistorter first"
        raise UnsupportedScan(where, f"camera model {photo.model}", "models that COLMAP undistorts", hint) from error


def _camera(photo: RegisteredPhoto, pinhole: pycolmap.Camera) -> Camera:
    k = pinhole.calibration_matrix()
    return Camera(
        name=photo.name,
        width_px=int(pinhole.width),
        height_px=int(pinhole.height),
        fx_px=float(k[0, 0]),
        fy_px=float(k[1, 1]),
        cx_px=float(k[0, 2]),
        cy_px=float(k[1, 2]),
        rotation=photo.rotation,
        centre=photo.centre,
    )


def _header_size(members: Members, name: str) -> tuple[int, int]:
    """Width and height of a photo, from its first bytes where they tell, else from the whole file."""
    where = members.label(name)
    n_bytes = members.size(name)
    try:
        with members.local(name, _PHOTO_HEAD_BYTES) as path:
            return photo_size(path, where)
    except InvalidScan:
        if n_bytes <= _PHOTO_HEAD_BYTES:
            raise
    with members.local(name) as path:  # a header longer than that, or at the end, as TIFF may have it
        return photo_size(path, where)


def _check_photo(members: Members, photo: RegisteredPhoto) -> None:
    name = f"{_PHOTOS}/{photo.name}"
    where = members.label(name)
    camera = f"camera {photo.camera_id} of {photo.width_px}x{photo.height_px} pixels"
    if members.size(name) is None:
        raise InvalidScan(where, f"missing, though registered with {camera}", "every registered photo in images/")
    width, height = _header_size(members, name)
    if (width, height) != (photo.width_px, photo.height_px):
        raise InvalidScan(where, f"a photo of {width}x{height} pixels, registered with {camera}", "the same size")


def _cameras(members: Members, photos: tuple[RegisteredPhoto, ...]) -> tuple[Camera, ...]:
    pinholes: dict[int, pycolmap.Camera] = {}
    for photo in photos:
        _check_photo(members, photo)
        if photo.camera_id not in pinholes:
            pinholes[photo.camera_id] = _undistorted(photo, members.label(f"sparse:camera {photo.camera_id}"))
    return tuple(_camera(p, pinholes[p.camera_id]) for p in photos)


def _read_photo(members: Members, photos: tuple[RegisteredPhoto, ...], i: int) -> np.ndarray:  # (height, width, 3)
    photo = photos[i]
    name = f"{_PHOTOS}/{photo.name}"
    _check_photo(members, photo)  # the file may have changed since the scan was opened
    with members.local(name) as path:
        pixels = decode_photo(path, members.label(name))
    if photo.model in _PINHOLE:
        return pixels
    options, bitmap = pycolmap.UndistortCameraOptions(), pycolmap.Bitmap.from_array(pixels)
    return pycolmap.undistort_image(options, bitmap, photo.camera)[0].to_array()


def _pieces_seen(members: Members, vertices: Vertices, n_cameras: int, max_points: int) -> Iterator[Piece]:
    with members.open(_VISIBILITY) as stream:
        visibility = VisibilityStream(stream, n_cameras, members.label(_VISIBILITY))
        for piece in vertices.pieces(max_points):
            counts, cameras = visibility.take(len(piece.position))
            yield replace(piece, visible_count=counts, visible_camera=cameras)
        visibility.finish()


def _slice(
    members: Folder, vertices: Vertices, n_cameras: int, is_seen: bool, first: int, stop: int, max_points: int
) -> Iterator[Piece]:
    pieces = vertices.slice(first, stop, max_points)
    if not is_seen:
        return pieces
    rows = [min(max_points, stop - at) for at in range(first, stop, max_points)]
    seen = visibility_from(members.label(_VISIBILITY), vertices.count, n_cameras, first, rows)
    return (
        replace(p, visible_count=counts, visible_camera=cameras)
        for p, (counts, cameras) in zip(pieces, seen, strict=True)
    )


def _open_points(members: Members) -> Vertices:
    n_bytes, where = members.size(_POINTS), members.label(_POINTS)
    if n_bytes is None:
        hint = "COLMAP's stereo_fusion writes it"
        raise InvalidScan(where, "missing", "a dense workspace with fused.ply", hint)
    return open_vertices(partial(members.open, _POINTS), n_bytes, where)


def _has_visibility(members: Members, n_points: int) -> bool:
    n_bytes = members.size(_VISIBILITY)
    if n_bytes is None:
        return False
    with members.open(_VISIBILITY) as stream:
        check_visibility(stream, n_bytes, n_points, members.label(_VISIBILITY))
    return True


def open_colmap(path: str) -> ScanSource:
    """A COLMAP dense workspace.

    Guarantees: a folder and its .zip give the same cameras, points and photos; nothing is left unpacked on disk.
    Raises: InvalidScan naming the file and what is wrong with it; UnsupportedScan for a camera model by name.
    """
    members = Folder(path) if os.path.isdir(path) else open_archive(path, _LANDMARKS)
    photos = read_model(members)
    vertices = _open_points(members)
    cameras = _cameras(members, photos)
    is_seen = _has_visibility(members, vertices.count)
    warnings = list(vertices.warnings)
    has_slices = isinstance(members, Folder) and vertices.has_slices  # what is packed is read from its start
    if not is_seen:
        warnings.append(f"{members.label(_VISIBILITY)}: missing; what each camera sees will come from a depth test")
    return ScanSource(
        path=path,
        format="colmap",
        n_points=vertices.count,
        pieces=partial(_pieces_seen, members, vertices, len(cameras)) if is_seen else vertices.pieces,
        read_slice=partial(_slice, members, vertices, len(cameras), is_seen) if has_slices else None,
        cameras=cameras,
        read_photo=partial(_read_photo, members, photos),
        has_normals="normal" in vertices.columns,
        has_colors="color" in vertices.columns,
        has_intensity="intensity" in vertices.columns,
        has_visibility=is_seen,
        warnings=tuple(warnings),
        details={
            "camera_models": dict(Counter(p.model for p in photos)),
            "comments": list(vertices.header.comments),
            "properties": [p.name for p in vertices.header.vertex.properties],
        },
    )
