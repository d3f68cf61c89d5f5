"""Photographs of an E57 file: `images2D` entries with a pose become cameras; a pinhole one, a panorama several (`panoramas.py`).

An E57 pinhole camera looks along -z of its own frame with y up, and its pose takes that frame to the file's; here
cameras look along +z with y down. The principal point counts from the outer corner of the first pixel.

References: ASTM E2807-11, section 8.4.4.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from pye57 import libe57

from pipeline.readers.e57.nodes import Pose, child_number, open_image_file, read_pose
from pipeline.readers.e57.panoramas import (
    STEEPEST,
    Panorama,
    Part,
    elevations,
    is_possible,
    look_at,
    parts_of,
    share_left_out,
    whole_sphere,
)
from pipeline.readers.photos import MAX_SIDE_PX, decode_photo, photo_size
from pipeline.scan import Camera
from storage.errors import InvalidScan

MAX_BLOB_BYTES = 1 << 30
LEAST_TOLD = 0.005  # of an image's pixels

_HEAD_BYTES = 1 << 18
_PINHOLE = "pinholeRepresentation"
_SPHERE, _CYLINDER = "sphericalRepresentation", "cylindricalRepresentation"
_USED = (_PINHOLE, _SPHERE, _CYLINDER)  # of an image that has several, the first
_BLOBS = {"jpegImage": ".jpg", "pngImage": ".png"}
_AZIMUTH = (
    "azimuths of spherical and cylindrical images are taken as the standard has them: 0 in an image's middle, growing to "
    "its left; where colours lie mirrored or turned, their writer had it otherwise"
)
_TO_Y_DOWN = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Blob:
    """Where a photo lies in the file, and which part it is of what panorama."""

    entry: int
    representation: str
    key: str
    panorama: Panorama | None = None
    part: Part | None = None

    @property
    def path(self) -> str:
        return f"images2D[{self.entry}].{self.representation}.{self.key}"


@dataclass(frozen=True)
class Images:
    """What `images2D` yields: cameras, and for each what its photo is read from."""

    cameras: tuple[Camera, ...] = ()
    blobs: tuple[Blob, ...] = ()
    warnings: tuple[str, ...] = ()


def _representation(image: libe57.StructureNode) -> str | None:
    return next((name for name in _USED if image.isDefined(name)), None)


def _why_not(image: libe57.StructureNode) -> str:
    """The reason why an image cannot be a camera, or ""."""
    used = _representation(image)
    if used is None:
        found = "visualReference" if image.isDefined("visualReferenceRepresentation") else "unknown"
        return f"its representation is {found}, not pinhole, spherical or cylindrical"
    if not image.isDefined("pose"):
        return "it has no pose"
    if not any(image[used].isDefined(name) for name in _BLOBS):
        return "it holds neither a JPEG nor a PNG"
    return ""


def _camera(
    name: str,
    size_px: tuple[int, int],
    focal_px: tuple[float, float],
    centre_px: tuple[float, float],
    rotation: np.ndarray,  # (3, 3), from the frame that the pose places to the camera's
    pose: Pose,
) -> Camera:
    turned = rotation @ np.array(pose.rotation).T
    return Camera(
        name=name,
        width_px=size_px[0],
        height_px=size_px[1],
        fx_px=focal_px[0],
        fy_px=focal_px[1],
        cx_px=centre_px[0],
        cy_px=centre_px[1],
        rotation=tuple(tuple(map(float, row)) for row in turned),  # type: ignore[misc]
        centre=pose.translation,
    )


def _pinhole_camera(name: str, pinhole: libe57.StructureNode, pose: Pose, where: str) -> Camera:
    size = _size(pinhole, where)
    focal_m, pixel_width_m, pixel_height_m = _lengths(pinhole, ("focalLength", "pixelWidth", "pixelHeight"), where)
    centre_x, centre_y = (float(child_number(pinhole, f"principalPoint{axis}", where)) for axis in "XY")
    return _camera(
        name, size, (focal_m / pixel_width_m, focal_m / pixel_height_m), (centre_x, centre_y), _TO_Y_DOWN, pose
    )


def _part_camera(name: str, part: Part, pose: Pose) -> Camera:
    size, focal, centre = (part.width_px, part.height_px), (part.focal_px, part.focal_px), (part.cx_px, part.cy_px)
    return _camera(name, size, focal, centre, np.array(part.rotation), pose)


def _size(node: libe57.StructureNode, where: str) -> tuple[int, int]:
    width, height = (int(child_number(node, n, where)) for n in ("imageWidth", "imageHeight"))
    if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX):
        raise InvalidScan(where, f"a size of {width}x{height} pixels", f"1 to {MAX_SIDE_PX} a side")
    return width, height


def _lengths(node: libe57.StructureNode, names: tuple[str, ...], where: str) -> list[float]:
    lengths = [float(child_number(node, n, where)) for n in names]
    if min(lengths) <= 0:
        raise InvalidScan(where, f"{', '.join(names)} of {lengths}", "lengths above 0")
    return lengths


def _panorama(node: libe57.StructureNode, is_sphere: bool, where: str) -> tuple[Panorama, str]:
    """What a panorama shows, and a warning where its own numbers do not say."""
    width, height = _size(node, where)
    if not is_sphere:
        pixel_width, pixel_m, radius_m = _lengths(node, ("pixelWidth", "pixelHeight", "radius"), where)
        horizon = float(child_number(node, "principalPointY", where))
        found = Panorama(width, height, pixel_width, horizon, pixel_m / radius_m, is_sphere=False)
    else:
        pixel_width, pixel_height = _lengths(node, ("pixelWidth", "pixelHeight"), where)
        found = Panorama(width, height, pixel_width, height / 2, pixel_height)
    if (whole := whole_sphere(found)) is not None:
        told = f"its pixels span {found.span:.3g} radians around; as it is twice as wide as high, taken for the whole sphere"
        return whole, told
    if not is_possible(found):
        raise InvalidScan(
            where, f"pixels that span {found.span:.3g} radians around", "a turn and half a turn up at most"
        )
    told = ""
    if (lost := share_left_out(found)) >= LEAST_TOLD:
        steep = max(math.degrees(e) for e in elevations(found))
        above = f"what it shows above {math.degrees(STEEPEST):.0f} of {steep:.0f} degrees off the horizon, and "
        corners = f"{above if math.radians(steep) > STEEPEST else ''}corners of its {len(parts_of(found))} photographs"
        told = f"{lost:.1%} of its pixels are not used: {corners}"
    return found, told


@contextmanager
def _on_disk(blob: libe57.BlobNode, suffix: str, max_bytes: int, where: str) -> Iterator[str]:
    n_bytes = blob.byteCount()
    if not 0 < n_bytes <= MAX_BLOB_BYTES:
        raise InvalidScan(where, f"a photo of {n_bytes} bytes", f"1 to {MAX_BLOB_BYTES}")
    content = np.empty(min(n_bytes, max_bytes), np.uint8)
    blob.read(content, 0, len(content))
    with tempfile.TemporaryDirectory(prefix="splatpress-") as folder:
        path = os.path.join(folder, f"photo{suffix}")
        content.tofile(path)
        yield path


def _blob_size(blob: libe57.BlobNode, suffix: str, where: str) -> tuple[int, int]:
    """Width and height from the photo's first bytes where they tell, else from all of it."""
    try:
        with _on_disk(blob, suffix, _HEAD_BYTES, where) as path:
            return photo_size(path, where)
    except InvalidScan:
        if blob.byteCount() <= _HEAD_BYTES:
            raise
    with _on_disk(blob, suffix, MAX_BLOB_BYTES, where) as path:
        return photo_size(path, where)


def _check_size(blob: libe57.BlobNode, suffix: str, declared: tuple[int, int], where: str) -> None:
    size = _blob_size(blob, suffix, where)
    if size != declared:
        found = f"a photo of {size[0]}x{size[1]} pixels, declared as {declared[0]}x{declared[1]}"
        raise InvalidScan(where, found, "the same size")


def _name_of(image: libe57.StructureNode, i: int, taken: set[str]) -> str:
    name = image["name"].value() if image.isDefined("name") else f"image {i}"
    return name if name not in taken else f"{name} ({i})"


def read_images(file: libe57.ImageFile, path: str) -> Images:
    """The cameras of an opened file; an image that cannot be one is named in a warning with the reason.

    Raises: InvalidScan for an image whose numbers or photo are wrong.
    """
    if not file.root().isDefined("images2D"):
        return Images()
    cameras: list[Camera] = []
    blobs: list[Blob] = []
    warnings: list[str] = []
    taken: set[str] = set()
    for i, image in enumerate(file.root()["images2D"]):
        name, where = _name_of(image, i, taken), f"{path}:images2D[{i}]"
        if reason := _why_not(image):
            warnings.append(f"{where} {name!r} is not used: {reason}")
            continue
        taken.add(name)
        used = _representation(image)
        node, pose, inside = image[used], read_pose(image, where), f"{where}.{used}"
        key = next(k for k in _BLOBS if node.isDefined(k))
        told = [f"{where} {name!r}: its mask is not used"] if node.isDefined("imageMask") else []
        if used == _PINHOLE:
            camera = _pinhole_camera(name, node, pose, inside)
            _check_size(node[key], _BLOBS[key], (camera.width_px, camera.height_px), f"{inside}.{key}")
            cameras.append(camera)
            blobs.append(Blob(i, used, key))
        else:
            panorama, doubt = _panorama(node, used == _SPHERE, inside)
            _check_size(node[key], _BLOBS[key], (panorama.width_px, panorama.height_px), f"{inside}.{key}")
            for k, part in enumerate(parts := parts_of(panorama)):
                cameras.append(_part_camera(f"{name} ({k + 1} of {len(parts)})", part, pose))
                blobs.append(Blob(i, used, key, panorama, part))
            told += [f"{where} {name!r}: {doubt}"] if doubt else []
        warnings += told
    if any(blob.panorama for blob in blobs):
        warnings.append(f"{path}: {_AZIMUTH}")
    return Images(tuple(cameras), tuple(blobs), tuple(warnings))


def read_photo(path: str, blobs: tuple[Blob, ...], i: int) -> np.ndarray:  # (height, width, 3)
    """Photo i as uint8 sRGB."""
    blob = blobs[i]
    where = f"{path}:{blob.path}"
    with open_image_file(path) as file:
        node = file.root()["images2D"][blob.entry][blob.representation][blob.key]
        with _on_disk(node, _BLOBS[blob.key], MAX_BLOB_BYTES, where) as photo:
            pixels = decode_photo(photo, where)
    return pixels if blob.part is None else look_at(blob.panorama, blob.part, pixels)
