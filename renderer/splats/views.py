"""Cameras to look from: those of the photographs at another size, and orbits around a scene."""

from __future__ import annotations

import numpy as np

from pipeline.cameras.pinhole import resized
from pipeline.splats.decoded import scene_bounds
from renderer.effects.relighting import has_own_lamp
from storage.packed.batches import CHUNKS_PER_GROUP
from storage.packed.packed import PackedScene
from storage.packed.schema import Camera, Header

Direction = tuple[float, float, float]  # in the scan's own axes, of any length
ORBIT_FIELD_DEGREES = 45.0  # of the shorter side of the picture
ORBIT_HEIGHT_DEGREES = 20.0
MARGIN = 1.08  # about what fills the picture
MOST_OUTLINED_BY_CHUNKS = 64  # groups; those of more stand in a file's table, which a viewer has before anything else
STRAY_SHARE = 0.02  # of chunks that a picture of the whole may leave out: stray and background points must not push the camera away
TRIMMED_SHARE, LONGEST_TAIL = (
    0.1,
    1.3,
)  # where there are more of them: no further than so many times what all but this share reach


def view_of(camera: Camera, size: tuple[int, int] | None = None) -> Camera:
    """A photo's camera for a picture of `size` (width, height) px, of the same field of view; see `resized`."""
    return resized(camera, *(size or (camera.width_px, camera.height_px)))


def orbit_views(scene: PackedScene, n: int, size: tuple[int, int], up: Direction | None = None) -> list[Camera]:
    """`n` cameras in a circle around the scene, looking slightly down on its middle, which fills the picture; `up` (3,) is the scan's where
    it is known better than the file does.

    The first one stands where the photographs were taken from, if there are any.
    """
    has_strays = not has_own_lamp(scene.header)  # surfaces of a volume have none: all of them is to be seen
    centre, reach = bulk_of(scene, STRAY_SHARE if has_strays else 0.0)
    middle = centre + scene.header.origin
    upright = up_direction(scene.header) if up is None else np.asarray(up, np.float64) / np.linalg.norm(up)
    start = _start_direction(scene.header, middle, upright)
    side = np.cross(upright, start)
    field = np.radians(ORBIT_FIELD_DEGREES)
    distance = MARGIN * max(reach, scene.header.radius) / np.sin(field / 2)
    height = np.radians(ORBIT_HEIGHT_DEGREES)
    views = []
    for index, angle in enumerate(np.arange(n) * 2 * np.pi / n):
        level = np.cos(angle) * start + np.sin(angle) * side
        centre = middle + distance * (np.cos(height) * level + np.sin(height) * upright)
        views.append(_camera_at(f"orbit_{index:03d}", centre, middle, upright, field, size))
    return views


def bulk_of(scene: PackedScene, share: float = STRAY_SHARE) -> tuple[np.ndarray, float]:
    """Middle (3,) against the origin and radius of a ball that holds all but a `share` of the chunks, of a large scene of the groups: the middle of the ranges that
    TRIMMED_SHARE of their centres lie below and above of, and how far all but the `share` reach from there, where that is no further than
    LONGEST_TAIL times what all but TRIMMED_SHARE do. With a `share` of 0 it holds all."""
    low, high = scene_bounds(scene)
    if scene.header.n_groups > MOST_OUTLINED_BY_CHUNKS:
        groups = np.arange(0, len(low), CHUNKS_PER_GROUP)
        low, high = np.minimum.reduceat(low, groups), np.maximum.reduceat(high, groups)
    centre, trimmed = (low + high) / 2, TRIMMED_SHARE if share else 0.0
    middle = np.quantile(centre, [trimmed, 1 - trimmed], axis=0).mean(axis=0)
    reach = np.linalg.norm(centre - middle, axis=1) + np.linalg.norm(high - low, axis=1) / 2
    most, usual = np.quantile(reach, [1 - share, 1 - trimmed])
    return middle, float(min(most, LONGEST_TAIL * usual))


def up_direction(header: Header) -> np.ndarray:
    """The scene's up direction, turned to where the tops of most photographs point."""
    up = np.array(header.up) / np.linalg.norm(header.up)
    tops = sum((-np.array(camera.rotation[1]) for camera in header.cameras), np.zeros(3))
    return -up if tops @ up < 0 else up


def _start_direction(header: Header, middle: np.ndarray, up: np.ndarray) -> np.ndarray:
    """A unit vector at right angles to `up`, from the middle to the photographs or, without any, along an axis."""
    towards = np.array(header.ahead, np.float64)
    if np.linalg.norm(np.cross(towards, up)) < 0.5 * np.linalg.norm(towards):  # another up than the file's
        towards = np.eye(3)[np.abs(up).argmin()]
    towards -= (towards @ up) * up
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
