"""The sparse model of a COLMAP workspace: which photos are registered, with what camera and pose.

pycolmap reads the model, but only after its files have been walked here: given a truncated file it may abort the
process, or return whatever was in memory. The walk hands pycolmap a copy without image points and 3D points, which
make up nearly all of a model and say nothing about cameras.

References: src/colmap/scene/reconstruction_io.cc in COLMAP 4.
"""

from __future__ import annotations

import io
import os
import struct
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import BinaryIO

import numpy as np
import pycolmap

from pipeline.readers.members import Members, escapes
from pipeline.readers.photos import MAX_SIDE_PX
from storage.errors import InvalidScan

MODEL_FOLDERS = ("sparse", "sparse/0")
MAX_NAME_BYTES = 4096
MAX_TEXT_BYTES = 1 << 26  # cameras.txt, rigs.txt, frames.txt
MAX_LINE_BYTES = 1 << 28  # a photo with 10 million image points in one line of images.txt

_N_POSE = 7  # quaternion w x y z, translation x y z
_SPACE = (
    b"\x1f"  # stands for the spaces of a name while pycolmap reads a text model: it takes a name to end at the first
)
_EMPTY_BIN = struct.pack("<Q", 0)


@dataclass(frozen=True)
class RegisteredPhoto:
    """One registered image as the model has it; the camera may be distorted."""

    name: str
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
    models = [m for name, m in pycolmap.CameraModelId.__members__.items() if name != "INVALID"]
    return {int(m): len(pycolmap.Camera.create_from_model_id(1, m, 1.0, 1, 1).params) for m in models}


class _Walk:
    """Takes fixed-size fields off a model file, keeps a copy, and refuses to read past the end."""

    def __init__(self, stream: BinaryIO, where: str) -> None:
        self.stream, self.where, self.copy, self.offset = stream, where, io.BytesIO(), 0

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
        while (byte := self.take("c")[0]) != b"\0":
            name += byte
            if len(name) > MAX_NAME_BYTES:
                raise InvalidScan(self.where, f"a name without an end at byte {self.offset}", f"{MAX_NAME_BYTES} bytes")
        return name.decode("utf-8", errors="replace")

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
        walk.take(f"I{_N_POSE}dI")
        walk.take_name()
        (n_points,) = walk.take("Q", keep=False)
        walk.skip(24 * n_points)
        walk.copy.write(_EMPTY_BIN)


def _walk_rigs(walk: _Walk) -> None:
    for _ in range(walk.take("Q")[0]):
        _, n_sensors = walk.take("II")
        for i in range(n_sensors):
            walk.take("iI")
            if i > 0 and walk.take("B")[0]:  # the first sensor is the reference and has no pose
                walk.take(f"{_N_POSE}d")


def _walk_frames(walk: _Walk) -> None:
    for _ in range(walk.take("Q")[0]):
        walk.take(f"II{_N_POSE}d")
        for _ in range(walk.take("I")[0]):
            walk.take("iIQ")


_WALKS: dict[str, Callable[[_Walk], None]] = {
    "cameras": _walk_cameras,
    "images": _walk_images,
    "rigs": _walk_rigs,
    "frames": _walk_frames,
}


def _text_without_points(stream: BinaryIO, where: str) -> bytes:
    """images.txt with its second lines, the image points, left empty."""
    kept, is_points = [], False
    while line := stream.readline(MAX_LINE_BYTES):
        if len(line) == MAX_LINE_BYTES:
            raise InvalidScan(where, f"a line of {MAX_LINE_BYTES} bytes", "shorter lines")
        if is_points:
            kept.append(b"\n")
            is_points = False
        elif line.strip() and not line.lstrip().startswith(b"#"):
            fields = line.split(None, _N_POSE + 2)  # number, pose, camera, and the name, which may hold spaces
            kept.append(b" ".join([*fields[:-1], fields[-1].rstrip().replace(b" ", _SPACE)]) + b"\n")
            is_points = True
    return b"".join(kept)


def _short_text(stream: BinaryIO, where: str) -> bytes:
    text = stream.read(MAX_TEXT_BYTES + 1)
    if len(text) > MAX_TEXT_BYTES:
        raise InvalidScan(where, f"more than {MAX_TEXT_BYTES} bytes", f"at most {MAX_TEXT_BYTES}")
    return text


def _find_model(members: Members) -> tuple[str, str]:
    """The folder and the ending of the model's files."""
    for folder in MODEL_FOLDERS:
        for ending in (".bin", ".txt"):
            if members.size(f"{folder}/cameras{ending}") is not None:
                return folder, ending
    allowed = "cameras and images as .bin or .txt in sparse/ or sparse/0/"
    hint = "a dense workspace is what COLMAP's image_undistorter and stereo_fusion write"
    raise InvalidScan(members.label("sparse"), "no COLMAP model", allowed, hint)


def _copy_model(members: Members, target: str) -> str:
    """Writes the checked model to `target`; returns a label for messages."""
    folder, ending = _find_model(members)
    for part, walk_part in _WALKS.items():
        name = f"{folder}/{part}{ending}"
        if members.size(name) is None:
            if part in ("cameras", "images"):
                raise InvalidScan(members.label(name), "missing", "cameras and images side by side")
            continue  # models older than COLMAP 3.12 have neither rigs nor frames
        with members.open(name) as stream, open(os.path.join(target, part + ending), "wb") as copy:
            if ending == ".txt":
                copy_text = _text_without_points if part == "images" else _short_text
                copy.write(copy_text(stream, members.label(name)))
            else:
                walk = _Walk(stream, members.label(name))
                walk_part(walk)
                copy.write(walk.finish())
    with open(os.path.join(target, "points3D" + ending), "wb") as empty:
        empty.write(_EMPTY_BIN if ending == ".bin" else b"")
    return members.label(folder)


def _check_size(where: str, width: int, height: int) -> None:
    if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX):
        raise InvalidScan(where, f"a size of {width}x{height} pixels", f"1 to {MAX_SIDE_PX} a side")


def _registered(model: pycolmap.Reconstruction, image_id: int, where: str) -> RegisteredPhoto:
    image = model.images[image_id]
    camera = model.cameras[image.camera_id]
    pose = image.cam_from_world()
    # The matrix of a quaternion of 0 is the identity, so the quaternion is what has to be checked.
    quaternion, centre = np.asarray(pose.rotation.quat), image.projection_center()
    name = image.name.replace(_SPACE.decode(), " ")
    label = f"{where}:image {name!r}"
    if escapes(name):
        raise InvalidScan(label, "a name that leaves images/", "relative names without '..' or '\\'")
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
        rotation=tuple(tuple(map(float, row)) for row in pose.rotation.matrix()),
        centre=tuple(map(float, centre)),
    )


def read_model(members: Members) -> tuple[RegisteredPhoto, ...]:
    """The registered photos in the order of `reg_image_ids`, which is the order `fused.ply.vis` counts in.

    Guarantees: binary and text models of the same scene give the same photos; time does not grow with 3D points.
    Raises: InvalidScan for a missing, truncated or contradictory model.
    """
    with tempfile.TemporaryDirectory(prefix="splatpress-") as target:
        where = _copy_model(members, target)
        try:
            model = pycolmap.Reconstruction(target)
            photos = tuple(_registered(model, image_id, where) for image_id in model.reg_image_ids())
        except (ValueError, IndexError, RuntimeError) as error:  # UnicodeDecodeError is a ValueError
            reason = str(error).strip().replace(target, where)
            raise InvalidScan(where, f"a model that pycolmap refuses ({reason[:300]})", "a whole model") from error
    if not photos:
        raise InvalidScan(where, "0 registered images", "at least one")
    names = [p.name for p in photos]
    if len(set(names)) < len(names):
        twice = next(n for n in names if names.count(n) > 1)
        raise InvalidScan(f"{where}:image {twice!r}", "a name that occurs twice", "every name once")
    return photos
