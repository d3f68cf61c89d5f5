"""Photographs of an E57 file: `images2D` entries with a pinhole representation and a pose become cameras.

An E57 pinhole camera looks along -z of its own frame with y up, and its pose takes that frame to the file's; here
cameras look along +z with y down. The principal point counts from the outer corner of the first pixel.

References: ASTM E2807-11, section 8.4.4.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from pye57 import libe57

from pipeline.readers.e57.nodes import Pose, child_number, open_image_file, read_pose
from pipeline.readers.photos import MAX_SIDE_PX, decode_photo, photo_size
from pipeline.scan import Camera
from storage.errors import InvalidScan

MAX_BLOB_BYTES = 1 << 30

_HEAD_BYTES = 1 << 18
_PINHOLE = "pinholeRepresentation"
_OTHERS = ("sphericalRepresentation", "cylindricalRepresentation", "visualReferenceRepresentation")
_BLOBS = {"jpegImage": ".jpg", "pngImage": ".png"}
_TO_Y_DOWN = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Images:
    """What `images2D` yields: cameras, and for each the entry and the blob its photo lies in."""

    cameras: tuple[Camera, ...] = ()
    blobs: tuple[tuple[int, str], ...] = ()
    warnings: tuple[str, ...] = ()


def _why_not(image: libe57.StructureNode) -> str:
    """The reason why an image cannot be a camera, or ""."""
    if not image.isDefined(_PINHOLE):
        found = [name.removesuffix("Representation") for name in _OTHERS if image.isDefined(name)]
        return f"its representation is {' and '.join(found) or 'unknown'}, not pinhole"
    if not image.isDefined("pose"):
        return "it has no pose"
    if not any(image[_PINHOLE].isDefined(name) for name in _BLOBS):
        return "it holds neither a JPEG nor a PNG"
    return ""


def _camera(name: str, pinhole: libe57.StructureNode, pose: Pose, where: str) -> Camera:
    width, height = (int(child_number(pinhole, n, where)) for n in ("imageWidth", "imageHeight"))
    if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX):
        raise InvalidScan(where, f"a size of {width}x{height} pixels", f"1 to {MAX_SIDE_PX} a side")
    lengths = [child_number(pinhole, n, where) for n in ("focalLength", "pixelWidth", "pixelHeight")]
    if min(lengths) <= 0:
        raise InvalidScan(where, f"focalLength, pixelWidth, pixelHeight of {lengths}", "lengths above 0")
    focal_m, pixel_width_m, pixel_height_m = lengths
    rotation = _TO_Y_DOWN @ np.array(pose.rotation).T
    return Camera(
        name=name,
        width_px=width,
        height_px=height,
        fx_px=focal_m / pixel_width_m,
        fy_px=focal_m / pixel_height_m,
        cx_px=float(child_number(pinhole, "principalPointX", where)),
        cy_px=float(child_number(pinhole, "principalPointY", where)),
        rotation=tuple(tuple(map(float, row)) for row in rotation),  # type: ignore[misc]
        centre=pose.translation,
    )


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


def _check_size(blob: libe57.BlobNode, suffix: str, camera: Camera, where: str) -> None:
    size = _blob_size(blob, suffix, where)
    if size != (camera.width_px, camera.height_px):
        found = f"a photo of {size[0]}x{size[1]} pixels, declared as {camera.width_px}x{camera.height_px}"
        raise InvalidScan(where, found, "the same size")


def _name_of(image: libe57.StructureNode, i: int, taken: set[str]) -> str:
    name = image["name"].value() if image.isDefined("name") else f"image {i}"
    return name if name not in taken else f"{name} ({i})"


def read_images(file: libe57.ImageFile, path: str) -> Images:
    """The cameras of an opened file; an image that cannot be one is named in a warning with the reason.

    Raises: InvalidScan for a pinhole image whose numbers or photo are wrong.
    """
    if not file.root().isDefined("images2D"):
        return Images()
    cameras: list[Camera] = []
    blobs: list = []
    warnings: list[str] = []
    for i, image in enumerate(file.root()["images2D"]):
        name = _name_of(image, i, {c.name for c in cameras})
        if reason := _why_not(image):
            warnings.append(f"{path}:images2D[{i}] {name!r} is not used: {reason}")
            continue
        where, pinhole = f"{path}:images2D[{i}]", image[_PINHOLE]
        camera = _camera(name, pinhole, read_pose(image, where), f"{where}.{_PINHOLE}")
        key = next(k for k in _BLOBS if pinhole.isDefined(k))
        _check_size(pinhole[key], _BLOBS[key], camera, f"{where}.{_PINHOLE}.{key}")
        cameras.append(camera)
        blobs.append((i, key))
        if pinhole.isDefined("imageMask"):
            warnings.append(f"{path}:images2D[{i}] {name!r}: its mask is not used")
    return Images(tuple(cameras), tuple(blobs), tuple(warnings))


def read_photo(path: str, blobs: tuple[tuple[int, str], ...], i: int) -> np.ndarray:  # (height, width, 3)
    """Photo i as uint8 sRGB."""
    entry, key = blobs[i]
    where = f"{path}:images2D[{entry}].{_PINHOLE}.{key}"
    with open_image_file(path) as file:
        blob = file.root()["images2D"][entry][_PINHOLE][key]
        with _on_disk(blob, _BLOBS[key], MAX_BLOB_BYTES, where) as photo:
            return decode_photo(photo, where)
