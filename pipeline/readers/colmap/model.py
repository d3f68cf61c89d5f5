"""The sparse model of a COLMAP workspace: which photos are registered, with what camera and pose.

pycolmap reads the model, but only after its files have been walked here: given a truncated file it may abort the
process, or return whatever was in memory. The walk hands pycolmap a copy without image points and 3D points, which
make up nearly all of a model and say nothing about cameras, and with numbers in place of names, which are bytes of any encoding.

References: src/colmap/scene/reconstruction_io.cc in COLMAP 4.
"""

from __future__ import annotations

import os
import tempfile
from collections import Counter
from dataclasses import dataclass

import numpy as np

from pipeline.readers.colmap.library import pycolmap
from pipeline.readers.colmap.text import plain_cameras, plain_images, plain_text
from pipeline.readers.colmap.walks import (
    EMPTY_BIN,
    NEEDED,
    WALKS,
    Walk,
    camera_models,
    check_size,
    n_params_by_model,
    token,
)
from pipeline.readers.files.members import Members, escapes
from pipeline.readers.files.spelling import shown
from storage.errors import InvalidScan


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


def _copy_model(members: Members, folder: str, target: str, parts: tuple[str, ...]) -> _Copied:
    """Writes these parts of the checked model to `target`."""
    ending, names, warnings = _ending_of(members, folder), {}, []

    def token_of(image_id: int, name: str) -> bytes:
        names[image_id] = name
        return token(image_id)

    for part in parts:
        found = members.names.find(_joined(folder, part + ending))
        if not found:
            continue
        where = shown(members.label(found[0]))
        with members.open(found[0]) as stream, open(os.path.join(target, part + ending), "wb") as copy:
            if ending == ".bin":
                walk = Walk(stream, where)
                WALKS[part](walk)
                copy.write(walk.finish())
                names |= walk.names
            elif part == "images":
                content, said = plain_images(stream, where, token_of)
                copy.write(content)
                warnings += said
            else:
                params = {name: n_params_by_model()[int(m)] for name, m in camera_models().items()}
                copy.write(plain_cameras(stream, where, params) if part == "cameras" else plain_text(stream, where))
    with open(os.path.join(target, "points3D" + ending), "wb") as empty:
        empty.write(EMPTY_BIN if ending == ".bin" else b"")
    return _Copied(shown(members.label(folder)), names, tuple(warnings))


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
    check_size(f"{where}:camera {camera.camera_id}", camera.width, camera.height)
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

    Guarantees: binary and text models of the same scene give the same photos; time does not grow with 3D points; rigs
    and frames that cannot be read are not needed.
    Raises: InvalidScan for a truncated or contradictory model; UnsupportedScan for a camera model by name.
    """
    try:
        copied, photos = _read_parts(members, folder, tuple(WALKS))
        said: tuple[str, ...] = ()
    except InvalidScan as error:
        if not _has_rigs(members, folder):
            raise
        try:
            copied, photos = _read_parts(members, folder, NEEDED)
        except InvalidScan:
            raise error from None
        said = (f"{error}; rigs and frames are not used, images say where cameras stand",)
    where = copied.where
    if not photos:
        raise InvalidScan(where, "0 registered images", "at least one")
    twice = [name for name, n in Counter(p.name for p in photos).items() if n > 1]
    if twice:
        raise InvalidScan(f"{where}:image {shown(twice[0])!r}", "a name that occurs twice", "every name once")
    return Model(folder, photos, (*copied.warnings, *said))


def _has_rigs(members: Members, folder: str) -> bool:
    ending = _ending_of(members, folder)
    return any(members.names.find(_joined(folder, part + ending)) for part in WALKS if part not in NEEDED)


def _read_parts(members: Members, folder: str, parts: tuple[str, ...]) -> tuple[_Copied, tuple[RegisteredPhoto, ...]]:
    """What pycolmap makes of these parts of a model. Raises: InvalidScan."""
    with tempfile.TemporaryDirectory(prefix="splatpress-") as target:
        copied = _copy_model(members, folder, target, parts)
        try:
            model = pycolmap.Reconstruction(target)
            return copied, tuple(_registered(model, image_id, copied) for image_id in model.reg_image_ids())
        except (ValueError, IndexError, KeyError, RuntimeError, TypeError) as error:
            # What pycolmap says names its own source files.
            found = f"{', '.join(parts)} that contradict each other"
            raise InvalidScan(copied.where, found, "a whole model, as COLMAP's model_converter writes it") from error
