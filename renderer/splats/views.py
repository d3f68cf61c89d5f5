"""Cameras to look from: those of the photographs at another size, and orbits around a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from pipeline.cameras.pinhole import resized
from pipeline.splats.decoded import scene_bounds, scene_radii
from renderer.effects.relighting import is_closed, may_have_strays
from storage.packed.batches import CHUNKS_PER_GROUP
from storage.packed.packed import PackedScene
from storage.packed.schema import CHUNK, Camera, Header

Direction = tuple[float, float, float]  # in the scan's own axes, of any length
ORBIT_FIELD_DEGREES = 45.0  # of the shorter side of the picture
ORBIT_HEIGHT_DEGREES = 20.0
STATION_FIELD_DEGREES = 70.0  # of the shorter side too
STATION_TILT_DEGREES, STATION_WAYS = 20.0, 12
MARGIN = 1.08  # about what fills the picture
SPARED = 1.2  # times the ball of the bulk: corners of a flat scan that it cuts off are no strays
FRAMED_FROM = 8  # directions of an orbit from each of which all of the bulk is to be in the picture
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
    """`n` cameras in a circle around the scene, looking slightly down on its middle, all as near as its bulk stays in
    the picture from FRAMED_FROM directions, whatever `n`; `up` (3,) is the scan's where it is known better than the
    file does.

    The first one stands where the photographs were taken from, if there are any.
    """
    low, high = bulk_of(scene)
    centre = (low.min(axis=0) + high.max(axis=0)) / 2
    middle = centre + scene.header.origin
    upright = up_direction(scene.header) if up is None else np.asarray(up, np.float64) / np.linalg.norm(up)
    start = _start_direction(scene.header, middle, upright)
    corners = _corners(low, high) - centre
    field = np.radians(ORBIT_FIELD_DEGREES)
    tangents = np.tan(field / 2) / MARGIN * np.asarray(size) / min(size)
    outwards = _outwards(start, upright, FRAMED_FROM)
    distance = max(scene.header.radius, *(_framing_distance(corners, out, upright, tangents) for out in outwards))
    return [
        _camera_at(f"orbit_{index:03d}", middle + distance * out, middle, upright, field, size)
        for index, out in enumerate(_outwards(start, upright, n))
    ]


def _outwards(start: np.ndarray, upright: np.ndarray, n: int) -> list[np.ndarray]:
    """Unit vectors (3,) from the middle of an orbit to its `n` cameras; the first is above `start`."""
    side, height = np.cross(upright, start), np.radians(ORBIT_HEIGHT_DEGREES)
    angles = np.arange(n) * 2 * np.pi / n
    return [np.cos(height) * (np.cos(a) * start + np.sin(a) * side) + np.sin(height) * upright for a in angles]


def _framing_distance(corners: np.ndarray, out: np.ndarray, upright: np.ndarray, tangents: np.ndarray) -> float:
    """How far along `out` a camera that looks back has to stand to see all `corners` (n, 3) within `tangents` (2,),
    across and up."""
    right, down = _camera_axes(-out, upright)
    seen = np.abs(corners @ np.stack([right, down], axis=1)) / tangents
    return float((seen.max(axis=1) + corners @ out).max())


def framed_views(scene: PackedScene, n: int, size: tuple[int, int], up: Direction | None = None) -> list[Camera]:
    """`orbit_views`, each turned to nothing else but moved to where the bulk of the scene, and what lies about it, just
    fills that picture: a flat or a long scan is larger in most. For single pictures; of a turntable the distance would
    pump.

    Guarantees: every corner of every box of the bulk lies inside every picture.
    """
    views = orbit_views(scene, n, size, up)
    low, high = bulk_of(scene, SPARED)  # of centres: a scan of one point is as wide as its disc
    corners = _corners(low - scene.header.radius, high + scene.header.radius) + scene.header.origin
    result = []
    for view in views:
        rotation, tangents = np.array(view.rotation), np.array(size) / [view.fx_px, view.fy_px] / 2 / MARGIN
        at = (corners - view.centre) @ rotation.T
        right, left = ((sign * at[:, :2] / tangents - at[:, 2:]).max(axis=0) for sign in (1, -1))
        # An eye `back` from there and `aside` sees all where back >= right - aside / tangents and back >= left + aside
        # / tangents.
        back = max((right + left).max() / 2, scene.header.radius - at[:, 2].min())
        aside = _centred(at, back, tangents * (right - back), tangents * (back - left))
        centre = np.array(view.centre) + np.array([*aside, -back]) @ rotation
        result.append(replace(view, centre=tuple(centre.tolist())))
    return result


def station_views(
    scene: PackedScene, stations: Sequence[tuple[float, float, float]], size: tuple[int, int]
) -> list[Camera]:
    """From where each laser scanner stood (absolute), towards where most of the scan lies: of STATION_WAYS level
    directions that with most chunks of the bulk within half of STATION_FIELD_DEGREES, tilted to their mean height by at
    most STATION_TILT_DEGREES; where nothing of the bulk would be in view, as above or below one that looked along what is
    called up, straight at it."""
    low, high = bulk_of(scene)
    upright, middle = up_direction(scene.header), (low + high) / 2 + scene.header.origin
    start = _start_direction(scene.header, np.zeros(3), upright)
    side, angles = np.cross(upright, start), np.arange(STATION_WAYS) * 2 * np.pi / STATION_WAYS
    ways = np.cos(angles)[:, None] * start + np.sin(angles)[:, None] * side  # (w, 3)
    views = []
    for index, station in enumerate(stations):
        away = middle - np.asarray(station, np.float64)
        height = away @ upright
        level = away - height[:, None] * upright
        distance = np.maximum(np.linalg.norm(level, axis=1), scene.header.radius)
        seen = level @ ways.T / distance[:, None] > np.cos(np.radians(STATION_FIELD_DEGREES / 2))  # (m, w)
        best = int(seen.sum(axis=0).argmax())
        rise = np.clip(
            (height / distance)[seen[:, best]].mean() if seen[:, best].any() else 0.0,
            *(np.tan(np.radians(STATION_TILT_DEGREES)) * np.array([-1, 1])),
        )
        aim, field, above = ways[best] + rise * upright, np.radians(STATION_FIELD_DEGREES), upright
        far = np.linalg.norm(away, axis=1) * np.linalg.norm(aim)
        if not (away @ aim > np.cos(field / 2) * far).any():
            aim = away.mean(axis=0) / max(np.linalg.norm(away.mean(axis=0)), scene.header.radius)
            above = start if abs(aim @ upright) > 0.9 else upright
        target = np.asarray(station) + max(distance.mean(), scene.header.radius) * aim
        views.append(
            _camera_at(f"station_{index + 1:03d}", np.asarray(station, np.float64), target, above, field, size)
        )
    return views


def _centred(at: np.ndarray, back: float, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """How far aside (2,), between `low` and `high`, an eye so far back has as much room on both sides of `at` (n, 3),
    in camera axes."""
    for _ in range(40):
        aside = (low + high) / 2
        off = (at[:, :2] - aside) / (at[:, 2:] + back)
        to_right = off.max(axis=0) + off.min(axis=0) > 0
        low, high = np.where(to_right, aside, low), np.where(to_right, high, aside)
    return (low + high) / 2


def _corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Of boxes (m, 3) each, (8 m, 3)."""
    return np.concatenate([np.where(pick, high, low) for pick in product((False, True), repeat=3)])


def bulk_of(scene: PackedScene, spared: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corners (m, 3) against the origin of the chunks, of levels those of the coarsest, of a large
    scene of the groups, that a picture of the whole
    shows: those within a ball about the middle of the ranges that TRIMMED_SHARE of their centres lie below and above
    of, as far as all but STRAY_SHARE reach from there, and no further than LONGEST_TAIL times what all but
    TRIMMED_SHARE do; `spared` times that. The surfaces of a volume have no strays: all of them."""
    low, high = scene_bounds(scene)
    if scene.header.levels:
        low, high = (side[: scene.header.levels[0] // CHUNK] for side in (low, high))
    elif scene.header.n_groups > MOST_OUTLINED_BY_CHUNKS:
        groups = np.arange(0, len(low), CHUNKS_PER_GROUP)
        low, high = np.minimum.reduceat(low, groups), np.maximum.reduceat(high, groups)
    if not may_have_strays(scene.header):
        return low, high
    centre = (low + high) / 2
    middle = np.quantile(centre, [TRIMMED_SHARE, 1 - TRIMMED_SHARE], axis=0).mean(axis=0)
    reach = np.linalg.norm(centre - middle, axis=1) + np.linalg.norm(high - low, axis=1) / 2
    most, usual = np.quantile(reach, [1 - STRAY_SHARE, 1 - TRIMMED_SHARE])
    within = reach <= max(spared * min(most, LONGEST_TAIL * usual), reach.min())
    return low[within], high[within]


def hides_backs(scene: PackedScene, views: Sequence[Camera]) -> bool:
    """Whether all discs that show their backs in these views are hidden by others: closed surfaces, seen from outside
    of all they reach to."""
    if not is_closed(scene.header):
        return False
    low, high = scene_bounds(scene)
    reach = float(scene_radii(scene).max())
    low, high = low.min(axis=0) - reach, high.max(axis=0) + reach
    at = np.array([view.centre for view in views]) - scene.header.origin
    return bool(((at < low) | (at > high)).any(axis=1).all())


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
    right, down = _camera_axes(forward, up)
    focal_px = min(size) / 2 / np.tan(field / 2)
    rotation = np.stack([right, down, forward])
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


def _camera_axes(forward: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (3,) to the right of and down in a picture that looks along `forward`, a unit vector too."""
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return right, np.cross(forward, right)
