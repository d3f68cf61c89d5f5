"""The files of a sparse model, walked field by field: every count checked against the file before pycolmap reads its copy."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable
from functools import cache
from typing import BinaryIO

import numpy as np

from pipeline.readers.colmap.library import pycolmap
from pipeline.readers.files.spelling import name_of
from pipeline.readers.photos import MAX_SIDE_PX
from storage.errors import InvalidScan

MAX_NAME_BYTES = 4096
NEARLY_ONE = 0.01  # how far the length of a quaternion may be from 1, as that of four digits is
EMPTY_BIN = struct.pack("<Q", 0)

_N_POSE = 7  # quaternion w x y z, translation x y z


@cache
def n_params_by_model() -> dict[int, int]:
    """How many parameters a camera has, by the number of its model."""
    return {int(m): len(pycolmap.Camera.create_from_model_id(1, m, 1.0, 1, 1).params) for m in camera_models().values()}


def camera_models() -> dict[str, pycolmap.CameraModelId]:
    """The camera models that COLMAP has, by their names."""
    return {name: m for name, m in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}


class Walk:
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


def check_size(where: str, width: int, height: int) -> None:
    """Raises InvalidScan for a camera without pixels, or with more of them a side than a photograph may have."""
    if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX):
        raise InvalidScan(where, f"a size of {width}x{height} pixels", f"1 to {MAX_SIDE_PX} a side")


def token(image_id: int) -> bytes:
    """What stands for an image's name while pycolmap reads the model."""
    return b"%d" % image_id


def _walk_cameras(walk: Walk) -> None:
    for _ in range(walk.take("Q")[0]):
        camera_id, model, width, height = walk.take("IiQQ")
        if model not in n_params_by_model():
            raise InvalidScan(f"{walk.where}:camera {camera_id}", f"camera model {model}", f"{[*n_params_by_model()]}")
        check_size(f"{walk.where}:camera {camera_id}", width, height)
        walk.take(f"{n_params_by_model()[model]}d")


def _walk_images(walk: Walk) -> None:
    for _ in range(walk.take("Q")[0]):
        (image_id,) = walk.take("I")
        walk.take_pose()
        walk.take("I")
        walk.names[image_id] = walk.take_name()
        walk.copy.write(token(image_id) + b"\0")
        (n_points,) = walk.take("Q", keep=False)
        walk.skip(24 * n_points)
        walk.copy.write(EMPTY_BIN)


def _walk_rigs(walk: Walk) -> None:
    for _ in range(walk.take("Q")[0]):
        _, n_sensors = walk.take("II")
        for i in range(n_sensors):
            walk.take("iI")
            if i > 0 and walk.take("B")[0]:  # the first sensor is the reference and has no pose
                walk.take_pose()


def _walk_frames(walk: Walk) -> None:
    for _ in range(walk.take("Q")[0]):
        walk.take("II")
        walk.take_pose()
        for _ in range(walk.take("I")[0]):
            walk.take("iIQ")


WALKS: dict[str, Callable[[Walk], None]] = {
    "cameras": _walk_cameras,
    "images": _walk_images,
    "rigs": _walk_rigs,
    "frames": _walk_frames,
}
NEEDED = ("cameras", "images")  # of a model; rigs and frames are of COLMAP 3.12 and later
