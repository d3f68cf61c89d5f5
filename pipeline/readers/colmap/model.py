"""The sparse model of a COLMAP workspace: which photos are registered, with what camera and pose.

pycolmap reads the model, but only after its files have been walked here: given a truncated file it may abort the
process, or return whatever was in memory. The walk hands pycolmap a copy without image points and 3D points, which
make up nearly all of a model and say nothing about cameras, and with numbers in place of names, which are bytes of any encoding.

References: src/colmap/scene/reconstruction_io.cc in COLMAP 4.
"""

from __future__ import annotations

import io
import os
import struct
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import BinaryIO

import numpy as np

from pipeline.readers.colmap.library import pycolmap
from pipeline.readers.colmap.text import plain_cameras, plain_images, plain_text
from pipeline.readers.files.members import Members, escapes
from pipeline.readers.files.spelling import name_of, shown
from pipeline.readers.photos import MAX_SIDE_PX
from storage.errors import InvalidScan

MAX_NAME_BYTES = 4096
NEARLY_ONE = 0.01  # how far the length of a quaternion may be from 1, as that of four digits is

_N_POSE = 7  # quaternion w x y z, translation x y z
_EMPTY_BIN = struct.pack("<Q", 0)


@dataclass(frozen=True)
class RegisteredPhoto:
    """One registered image as the model has it; the camera may be distorted."""

    name: str  # as Python's file functions have it
    camera_id: int
    model: str
    width_px: int
    height_px: int
    params: tuple[float, ...]
    rotation: tuple[tuple[float, float, float], ...]  # (3, 3) world to camera
    centre: tuple[float, float, float]

    @property
    def camera(self) -> pycolmap.Camera:
        size = {"width": self.width_px, "height": self.height_px}
        return pycolmap.Camera(model=self.model, params=list(self.params), **size)


@cache
def _n_params_by_model() -> dict[int, int]:
    return {int(m): len(pycolmap.Camera.create_from_model_id(1, m, 1.0, 1, 1).params) for m in _models().values()}


def _models() -> dict[str, pycolmap.CameraModelId]:
    return {name: m for name, m in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}


class _Walk:
    """Takes fixed-size fields off a model file, keeps a copy, and refuses to read past the end."""

    def __init__(self, stream: BinaryIO, where: str) -> None:
        self.stream, self.where, self.copy, self.offset = stream, where, io.BytesIO(), 0
        self.names: dict[int, str] = {}

    def take(self, layout: str, keep: bool = True) -> tuple:
        size = struct.calcsize("<" + layout)
        block = self.stream.read(size)
        if len(block) < size:
            found = f"{size} bytes wanted at byte {self.offset}, {len(block)} there"
            raise InvalidScan(self.where, found, "a whole file", "the file may be truncated")
        self.offset += size
        self.copy.write(block if keep else b"")
        return struct.unpack("<" + layout, block)

    def take_name(self) -> str:
        name = bytearray()
        while (byte := self.take("c", keep=False)[0]) != b"\0":
            name += byte
            if len(name) > MAX_NAME_BYTES:
                raise InvalidScan(self.where, f"a name without an end at byte {self.offset}", f"{MAX_NAME_BYTES} bytes")
        return name_of(bytes(name))

    def take_pose(self) -> None:
        """A quaternion, which is made of length 1 where it nearly is, and a translation."""
        pose = np.array(self.take(f"{_N_POSE}d", keep=False))
        length = np.linalg.norm(pose[:4])
        if np.isfinite(length) and abs(length - 1) < NEARLY_ONE:
            pose[:4] /= length
        self.copy.write(struct.pack(f"<{_N_POSE}d", *pose))

    def skip(self, n_bytes: int) -> None:
        for first in range(0, n_bytes, 1 << 20):
            self.take(f"{min(1 << 20, n_bytes - first)}s", keep=False)

    def finish(self) -> bytes:
        if self.stream.read(1):
            raise InvalidScan(self.where, f"bytes after its end at byte {self.offset}", "no trailing bytes")
        return self.copy.getvalue()


def _walk_cameras(walk: _Walk) -> None:
    for _ in range(walk.take("Q")[0]):
        camera_id, model, width, height = walk.take("IiQQ")
        if model not in _n_params_by_model():
            raise InvalidScan(f"{walk.where}:camera {camera_id}", f"camera model {model}", f"{[*_n_params_by_model()]}")
        _check_size(f"{walk.where}:camera {camera_id}", width, height)
        walk.take(f"{_n_params_by_model()[model]}d")


def _walk_images(walk: _Walk) -> None:
    for _ in range(walk.take("Q")[0]):
        (image_id,) = walk.take("I")
        walk.take_pose()
        walk.take("I")
        walk.names[image_id] = walk.take_name()
        walk.copy.write(_token(image_id) + b"\0")
        (n_points,) = walk.take("Q", keep=False)
        walk.skip(24 * n_points)
        walk.copy.write(_EMPTY_BIN)


def _walk_rigs(walk: _Walk) -> None:
    for _ in range(walk.take("Q")[0]):
        _, n_sensors = walk.take("II")
        for i in range(n_sensors):
            walk.take("iI")
            if i > 0 and walk.take("B")[0]:  # the first sensor is the reference and has no pose
                walk.take_pose()


def _walk_frames(walk: _Walk) -> None:
    for _ in range(walk.take("Q")[0]):
        walk.take("II")
        walk.take_pose()
        for _ in range(walk.take("I")[0]):
            walk.take("iIQ")


_WALKS: dict[str, Callable[[_Walk], None]] = {
    "cameras": _walk_cameras,
    "images": _walk_images,
    "rigs": _walk_rigs,
    "frames": _walk_frames,
}


def _token(image_id: int) -> bytes:
    """What stands for an image's name while pycolmap reads the model."""
    return b"%d" % image_id


@dataclass(frozen=True)
class _Copied:
    """A model written for pycolmap; `names` by image."""

    where: str
    names: dict[int, str]
    warnings: tuple[str, ...]


def _ending_of(members: Members, folder: str) -> str:
    """ ".bin" or ".txt", as the model's files end; the former where there are both."""
    for ending in (".bin", ".txt"):
        if all(members.names.find(_joined(folder, part + ending)) for part in ("cameras", "images")):
            return ending
    raise InvalidScan(
        members.label(folder), "no whole COLMAP model", "cameras and images side by side, as .bin or .txt"
    )


def _joined(folder: str, name: str) -> str:
    return f"{folder}/{name}" if folder else name


def _copy_model(members: Members, folder: str, target: str) -> _Copied:
    """Writes the checked model to `target`."""
    ending, names, warnings = _ending_of(members, folder), {}, []

    def token_of(image_id: int, name: str) -> bytes:
        names[image_id] = name
        return _token(image_id)

    for part, walk_part in _WALKS.items():
        found = members.names.find(_joined(folder, part + ending))
        if not found:
            continue  # models older than COLMAP 3.12 have neither rigs nor frames
        where = shown(members.label(found[0]))
        with members.open(found[0]) as stream, open(os.path.join(target, part + ending), "wb") as copy:
            if ending == ".bin":
                walk = _Walk(stream, where)
                walk_part(walk)
                copy.write(walk.finish())
                names |= walk.names
            elif part == "images":
                content, said = plain_images(stream, where, token_of)
                copy.write(content)
                warnings += said
            else:
                params = {name: _n_params_by_model()[int(m)] for name, m in _models().items()}
                copy.write(plain_cameras(stream, where, params) if part == "cameras" else plain_text(stream, where))
    with open(os.path.join(target, "points3D" + ending), "wb") as empty:
        empty.write(_EMPTY_BIN if ending == ".bin" else b"")
    return _Copied(shown(members.label(folder)), names, tuple(warnings))


def _check_size(where: str, width: int, height: int) -> None:
    if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX):
        raise InvalidScan(where, f"a size of {width}x{height} pixels", f"1 to {MAX_SIDE_PX} a side")


def _registered(model: pycolmap.Reconstruction, image_id: int, copied: _Copied) -> RegisteredPhoto:
    image = model.images[image_id]
    camera = model.cameras[image.camera_id]
    pose = image.cam_from_world()
    # The matrix of a quaternion of 0 is the identity, so the quaternion is what has to be checked.
    quaternion, centre = np.asarray(pose.rotation.quat), image.projection_center()
    name, where = copied.names[image_id], copied.where
    label = f"{where}:image {shown(name)!r}"
    if escapes(name):
        raise InvalidScan(label, "a name that leaves images/", "relative names without '..'")
    _check_size(f"{where}:camera {camera.camera_id}", camera.width, camera.height)
    if not abs(np.linalg.norm(quaternion) - 1) < 1e-6 or not np.isfinite(centre).all():
        raise InvalidScan(f"{label}.pose", f"quaternion {quaternion}, centre {centre}", "a rotation and finite numbers")
    focal_lengths = [camera.params[i] for i in camera.focal_length_idxs()]
    if not np.isfinite(camera.params).all() or any(f <= 0 for f in focal_lengths):
        raise InvalidScan(f"{where}:camera {camera.camera_id}", f"parameters {list(camera.params)}", camera.params_info)
    return RegisteredPhoto(
        name=name,
        camera_id=int(image.camera_id),
        model=camera.model.name,
        width_px=int(camera.width),
        height_px=int(camera.height),
        params=tuple(float(p) for p in camera.params),
        rotation=tuple(tuple(map(float, row)) for row in pose.rotation.matrix()),  # type: ignore[misc]
        centre=tuple(map(float, centre)),  # type: ignore[arg-type]
    )


@dataclass(frozen=True)
class Model:
    """A sparse model: its registered photos, in the order of `reg_image_ids`, which is the order `fused.ply.vis` counts in."""

    folder: str
    photos: tuple[RegisteredPhoto, ...]
    warnings: tuple[str, ...] = ()


def read_model(members: Members, folder: str) -> Model:
    """The model in a folder of the workspace.

    Guarantees: binary and text models of the same scene give the same photos; time does not grow with 3D points.
    Raises: InvalidScan for a truncated or contradictory model; UnsupportedScan for a camera model by name.
    """
    with tempfile.TemporaryDirectory(prefix="splatpress-") as target:
        copied = _copy_model(members, folder, target)
        try:
            model = pycolmap.Reconstruction(target)
            photos = tuple(_registered(model, image_id, copied) for image_id in model.reg_image_ids())
        except (ValueError, IndexError, KeyError, RuntimeError, TypeError) as error:
            # What pycolmap says names its own source files.
            found = "cameras, images, rigs and frames that contradict each other"
            raise InvalidScan(copied.where, found, "a whole model, as COLMAP's model_converter writes it") from error
    where = copied.where
    if not photos:
        raise InvalidScan(where, "0 registered images", "at least one")
    twice = [name for name, n in Counter(p.name for p in photos).items() if n > 1]
    if twice:
        raise InvalidScan(f"{where}:image {shown(twice[0])!r}", "a name that occurs twice", "every name once")
    return Model(folder, photos, copied.warnings)
