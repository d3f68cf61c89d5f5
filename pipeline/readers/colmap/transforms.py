"""`transforms.json` of nerfstudio and instant-ngp: photographs with poses, and the name of a file of points.

Cameras there look along -z of their own frame with y up, and the matrix takes that frame to the world.

References: nerfstudio, "Data conventions".
"""

from __future__ import annotations

import json
import math

import numpy as np

from pipeline.readers.colmap.model import Model, RegisteredPhoto
from pipeline.readers.files.members import Members
from pipeline.readers.files.spelling import shown
from pipeline.readers.photos import MAX_SIDE_PX, photo_size
from storage.errors import InvalidScan, UnsupportedScan

MAX_BYTES = 1 << 26
SUFFIXES = (".png", ".jpg", ".jpeg")  # that a path may leave out
_TO_Y_DOWN = np.diag([1.0, -1.0, -1.0])
# nerfstudio's name: COLMAP's name, and which distortions it takes after fx, fy, cx, cy
_MODELS = {
    "OPENCV": ("OPENCV", ("k1", "k2", "p1", "p2")),
    "PINHOLE": ("PINHOLE", ()),
    "SIMPLE_PINHOLE": ("PINHOLE", ()),
    "OPENCV_FISHEYE": ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
}


def _place_of(error: ValueError | RecursionError) -> str:
    if isinstance(error, json.JSONDecodeError):
        return f" from line {error.lineno}, column {error.colno} on"
    return ", or not in UTF-8" if isinstance(error, UnicodeDecodeError) else ""


def read_transforms(members: Members, name: str) -> tuple[Model, str | None]:
    """The photos of a transforms.json as a model, and the file of points that it names.

    Raises: InvalidScan naming the frame and the value; UnsupportedScan for a camera model by name.
    """
    where = shown(members.label(name))
    with members.open(name) as stream:
        text = stream.read(MAX_BYTES + 1)
    try:
        data = json.loads(text.decode("utf-8-sig")) if len(text) <= MAX_BYTES else None
    except (ValueError, RecursionError) as error:
        raise InvalidScan(where, f"no JSON{_place_of(error)}", "what nerfstudio writes") from error
    if not isinstance(data, dict) or not isinstance(data.get("frames"), list) or not data["frames"]:
        raise InvalidScan(f"{where}:frames", "missing or empty", "a list of photographs with poses")
    beside = name[: name.rindex("/") + 1] if "/" in name else ""
    photos = tuple(
        _photo(data, _whole(data, frame, members, beside), f"{where}:frames[{i}]", i)
        for i, frame in enumerate(data["frames"])
    )
    points = data.get("ply_file_path")
    return Model(name, photos), points if isinstance(points, str) else None


def _whole(data: dict, frame: object, members: Members, beside: str) -> object:
    """A frame with the suffix of its photograph and its size, where it leaves them out as those of rendered scenes do."""
    if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
        return frame
    path = frame["file_path"].replace("\\", "/").removeprefix("./")
    there = next((s for s in ("", *SUFFIXES) if members.size(beside + path + s) is not None), None)
    if there is None:
        return frame
    added: dict[str, object] = {"file_path": path + there} if there else {}
    if not {"w", "h"} <= {*data, *frame}:
        with members.local(beside + path + there) as photo:
            added |= dict(zip(("w", "h"), photo_size(photo, shown(members.label(beside + path + there))), strict=True))
    return {**frame, **added}


def _value(data: dict, frame: dict, name: str, where: str, default: float | None = None) -> float:
    value = frame.get(name, data.get(name, default))
    if not isinstance(value, (int, float)) or isinstance(value, bool) or not math.isfinite(value):
        raise InvalidScan(f"{where}.{name}", f"{value!r}"[:60], "a finite number")
    return float(value)


def _photo(data: dict, frame: object, where: str, i: int) -> RegisteredPhoto:
    if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
        raise InvalidScan(f"{where}.file_path", "missing", "the path of a photograph")
    kind = frame.get("camera_model", data.get("camera_model", "OPENCV"))
    if kind not in _MODELS:
        raise UnsupportedScan(f"{where}.camera_model", f"{kind!r}"[:60], ", ".join(_MODELS))
    model, distortions = _MODELS[kind]
    width, height = (int(_value(data, frame, n, where)) for n in ("w", "h"))
    if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX):
        raise InvalidScan(where, f"a size of {width}x{height} pixels", f"1 to {MAX_SIDE_PX} a side")
    lens = [_value(data, frame, n, where, 0.0) for n in distortions]
    if not any(lens):
        model, lens = "PINHOLE", []
    focal = _focal_lengths(data, frame, where, width)
    middle = [_value(data, frame, n, where, side / 2) for n, side in (("cx", width), ("cy", height))]
    rotation, centre = _pose(frame, where)
    return RegisteredPhoto(
        name=frame["file_path"].removeprefix("./"),
        camera_id=i,
        model=model,
        width_px=width,
        height_px=height,
        params=(*focal, *middle, *lens),
        rotation=tuple(tuple(map(float, row)) for row in rotation),  # type: ignore[misc]
        centre=tuple(map(float, centre)),  # type: ignore[arg-type]
    )


def _focal_lengths(data: dict, frame: dict, where: str, width: int) -> list[float]:
    """fx and fy in pixels; instant-ngp may give the angle of view instead."""
    if "fl_x" not in {**data, **frame} and "camera_angle_x" in {**data, **frame}:
        fx = width / 2 / math.tan(_value(data, frame, "camera_angle_x", where) / 2)
    else:
        fx = _value(data, frame, "fl_x", where)
    focal = [fx, _value(data, frame, "fl_y", where, fx)]
    if not all(0 < f < 1e9 for f in focal):
        raise InvalidScan(f"{where}.fl_x", f"{focal}", "lengths above 0")
    return focal


def _pose(frame: dict, where: str) -> tuple[np.ndarray, np.ndarray]:
    """World to camera (3, 3), looking along +z with y down, and the camera's centre (3,)."""
    try:
        matrix = np.array(frame.get("transform_matrix"), np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        raise InvalidScan(f"{where}.transform_matrix", "no 4 x 4 matrix", "finite numbers")
    turn = matrix[:3, :3]
    if np.abs(turn @ turn.T - np.eye(3)).max() > 1e-3 or np.linalg.det(turn) < 0:
        raise InvalidScan(f"{where}.transform_matrix", "not a rotation", "a rotation and a translation")
    left, _, right = np.linalg.svd(turn)
    return _TO_Y_DOWN @ (left @ right).T, matrix[:3, 3]
