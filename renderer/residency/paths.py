"""Recorded paths: poses at 90 frames a second, and the four of the paper for any scan (2020, section 5.2.1).

A path file is JSON: {"frames_per_second", "poses": [{"rotation": [[...]], "centre": [...]}]}, rotations from the world
to the viewer (x right, y down, z ahead), centres in the scan's own unit.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline, Slerp

from renderer.residency.places import Pose
from storage.errors import InvalidScan
from storage.packed.schema import Camera

FRAMES_PER_SECOND = 90
NAMES = ("look_around", "forward", "backward", "sideways")
SECONDS = 4.0
NEAR_SHARE, FAR_SHARE = 0.35, 0.8  # of the photograph's distance to what it shows: where a viewer walks
TURN_DEGREES, NOD_DEGREES = 30.0, 8.0  # a head's, to each side
SIDE_SHARE = 0.5  # of that distance: how far a sideways path goes, in all
MOST_POSES = 1 << 20


@dataclass(frozen=True)
class Path90:
    """A path by its name."""

    name: str
    poses: tuple[Pose, ...]


def made_paths(camera: Camera, distance: float, up: np.ndarray | None = None) -> dict[str, Path90]:
    """The four paths, from a photograph's pose and its distance to what it shows; with the head upright where `up` (3,)
    is given, for photographs may lie on their side.

    `look_around` turns the head in place, `forward` and `backward` walk at constant speed along the view, `sideways`
    slides across it with the head straight: at the near distance new parts come into view fast.
    """
    rotation, centre = np.array(camera.rotation), np.array(camera.centre)
    if up is not None:
        rotation = _upright(rotation[2], up)
    ahead, right = rotation[2], rotation[0]
    t = np.linspace(0.0, 1.0, round(SECONDS * FRAMES_PER_SECOND))
    near = centre + (1 - NEAR_SHARE) * distance * ahead

    def turned(s: float) -> np.ndarray:
        yaw = -np.radians(TURN_DEGREES) * np.cos(2 * np.pi * s)
        nod = np.radians(NOD_DEGREES) * np.cos(4 * np.pi * s)
        return _turn(nod, 0) @ _turn(yaw, 1) @ rotation

    look = tuple(Pose(turned(s), centre + (1 - 1.5 * NEAR_SHARE) * distance * ahead) for s in t)
    walk = tuple(
        Pose(rotation, centre + (1 - (FAR_SHARE + (NEAR_SHARE - FAR_SHARE) * s)) * distance * ahead) for s in t
    )
    side = tuple(Pose(rotation, near + SIDE_SHARE * (s - 0.5) * distance * right) for s in t)
    return {
        "look_around": Path90("look_around", look),
        "forward": Path90("forward", walk),
        "backward": Path90("backward", walk[::-1]),
        "sideways": Path90("sideways", side),
    }


def _upright(ahead: np.ndarray, up: np.ndarray) -> np.ndarray:
    """World to viewer, who looks `ahead`; his head's top points as far up as it can."""
    right = np.cross(ahead, up)
    if np.linalg.norm(right) < 1e-6:  # straight up or down: any side will do
        right = np.cross(ahead, np.eye(3)[np.argmin(np.abs(ahead))])
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(ahead, right), ahead])


def through(name: str, keys: tuple[Pose, ...], seconds: float) -> Path90:
    """A path of that many seconds through `keys`, 2 or more: a cubic spline of centres, and of rotations, that reaches
    them at even intervals.

    Raises: ValueError for fewer keys.
    """
    if len(keys) < 2:
        raise ValueError(f"{len(keys)} poses; allowed: 2 or more")
    at, t = np.linspace(0.0, 1.0, len(keys)), np.linspace(0.0, 1.0, max(2, round(seconds * FRAMES_PER_SECOND)))
    turns = Rotation.from_matrix(np.stack([key.rotation for key in keys]))
    rotations = (RotationSpline(at, turns) if len(keys) > 2 else Slerp(at, turns))(t).as_matrix()
    centres = CubicSpline(at, np.stack([key.centre for key in keys]))(t)
    return Path90(name, tuple(Pose(rotation, centre) for rotation, centre in zip(rotations, centres, strict=True)))


def pose_of(camera: Camera) -> Pose:
    """Where a photograph was taken from."""
    return Pose(np.array(camera.rotation), np.array(camera.centre))


def read_path(path: Path) -> Path90:
    """Raises: InvalidScan for a file that is no path."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        rows = data["poses"]
        if not 2 <= len(rows) <= MOST_POSES:
            raise ValueError(f"{len(rows)} poses")
        poses = tuple(_pose(row) for row in rows)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InvalidScan(
            str(path),
            f"no path ({type(error).__name__}: {error})",
            '{"poses": [{"rotation", "centre"}, ...]}, 2 or more',
        ) from error
    return Path90(path.stem, poses)


def path_json(path: Path90) -> dict:
    """A recorded path as JSON: world-to-camera rotations and centres, a pose a frame."""
    poses = [{"rotation": pose.rotation.tolist(), "centre": pose.centre.tolist()} for pose in path.poses]
    return {"frames_per_second": FRAMES_PER_SECOND, "poses": poses}


def _pose(row: dict) -> Pose:
    rotation, centre = np.array(row["rotation"], np.float64), np.array(row["centre"], np.float64)
    if (
        rotation.shape != (3, 3)
        or centre.shape != (3,)
        or not (np.isfinite(rotation).all() and np.isfinite(centre).all())
    ):
        raise ValueError("a pose is a 3x3 rotation and 3 coordinates, all finite")
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) or np.linalg.det(rotation) < 0:
        raise ValueError("a rotation that is none")
    return Pose(rotation, centre)


def _turn(angle: float, axis: int) -> np.ndarray:
    """About x (0) or y (1) of the viewer."""
    cos, sin = np.cos(angle), np.sin(angle)
    if axis == 0:
        return np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
    return np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
