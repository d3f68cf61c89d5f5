"""Cameras to look from: those of the photographs at another size, and orbits around a scene."""

from __future__ import annotations

import numpy as np

from pipeline.cameras.pinhole import resized
from pipeline.splats.decoded import scene_bounds
from renderer.effects.relighting import has_own_lamp
from storage.packed.packed import PackedScene
from storage.packed.schema import Camera, Header

ORBIT_FIELD_DEGREES = 45.0  # of the shorter side of the picture
ORBIT_HEIGHT_DEGREES = 20.0
TRIMMED_SHARE = 0.1  # of chunks at each end of each axis: stray and background points must not push the camera away


def view_of(camera: Camera, size: tuple[int, int] | None = None) -> Camera:
    """A photo's camera for a picture of `size` (width, height) px, of the same field of view; see `resized`."""
    return resized(camera, *(size or (camera.width_px, camera.height_px)))


def orbit_views(
    scene: PackedScene, n: int, size: tuple[int, int], up: tuple[float, float, float] | None = None
) -> list[Camera]:
    """`n` cameras in a circle around the scene, looking slightly down on its middle, which fills the picture. `up` is
    where the picture's top is, of a scene that lies otherwise than its header says.

    The first one stands where the photographs were taken from, if there are any.
    """
    has_strays = not has_own_lamp(scene.header)  # surfaces of a volume have none: all of them is to be seen
    low, high = trimmed_box(scene, TRIMMED_SHARE if has_strays else 0.0)
    middle = (low + high) / 2 + scene.header.origin
    above = up_direction(scene.header) if up is None else np.array(up) / np.linalg.norm(up)
    start = _start_direction(scene.header, middle, above)
    side = np.cross(above, start)
    field = np.radians(ORBIT_FIELD_DEGREES)
    distance = max(np.linalg.norm(high - low) / 2, scene.header.radius) / np.sin(field / 2)
    height = np.radians(ORBIT_HEIGHT_DEGREES)
    views = []
    for index, angle in enumerate(np.arange(n) * 2 * np.pi / n):
        level = np.cos(angle) * start + np.sin(angle) * side
        centre = middle + distance * (np.cos(height) * level + np.sin(height) * above)
        views.append(_camera_at(f"orbit_{index:03d}", centre, middle, above, field, size))
    return views


def trimmed_box(scene: PackedScene, share: float = TRIMMED_SHARE) -> tuple[np.ndarray, np.ndarray]:
    """Low and high corner (3,) against the origin of what most chunks lie in.

    The middle 1 - 2 `share` of the chunk centres, stretched to what that would be the middle of were they even.
    """
    low, high = scene_bounds(scene)
    centre = (low + high) / 2
    low, high = np.quantile(centre, [share, 1 - share], axis=0)
    half = (high - low) / 2 / (1 - 2 * share)
    return (low + high) / 2 - half, (low + high) / 2 + half


def up_direction(header: Header) -> np.ndarray:
    """The scene's up direction, turned to where the tops of most photographs point."""
    up = np.array(header.up) / np.linalg.norm(header.up)
    tops = sum((-np.array(camera.rotation[1]) for camera in header.cameras), np.zeros(3))
    return -up if tops @ up < 0 else up


def _start_direction(header: Header, middle: np.ndarray, up: np.ndarray) -> np.ndarray:
    """A unit vector at right angles to `up`, from the middle to the photographs or, without any, along an axis."""
    towards = np.array(header.ahead, np.float64)
    if header.cameras:
        mean = np.mean([camera.centre for camera in header.cameras], axis=0) - middle
        level = mean - (mean @ up) * up
        if np.linalg.norm(level) > 1e-6 * np.linalg.norm(mean):
            towards = level
    if abs(towards @ up) > 1e-9 * np.linalg.norm(towards):  # another up than the header's
        towards = towards - (towards @ up) * up
    if np.linalg.norm(towards) < 1e-6:
        towards = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    return towards / np.linalg.norm(towards)


def _camera_at(
    name: str, centre: np.ndarray, target: np.ndarray, up: np.ndarray, field: float, size: tuple[int, int]
) -> Camera:
    """A camera that looks at `target`; `field` in radians is what the shorter side of the picture sees."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    focal_px = min(size) / 2 / np.tan(field / 2)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Camera(
        name,
        *size,
        focal_px,
        focal_px,
        size[0] / 2,
        size[1] / 2,
        tuple(map(tuple, rotation.tolist())),
        tuple(centre.tolist()),
    )
