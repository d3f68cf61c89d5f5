"""Which camera sees a splat best: the one that has most photo pixels for it, among those that see it at all.

The pixels that a camera has for a disc of a given size go with cos(angle) * (f / distance)^2, so angle and distance
are weighed against each other as sharpness, not by taste.
"""

from __future__ import annotations

import numpy as np

from pipeline.execution.compiled import kernel
from storage.packed.schema import NO_CAMERA, Camera

N_CANDIDATES = 8  # of a point's cameras the best are kept: a fixed width that can be streamed and sorted
TINY = np.finfo(float).tiny
STEEPEST_COSINE = 0.1  # 84 degrees: beyond it a texture is a smear (mvs-texturing cuts at 75, issue 84 there)


def sharpness(camera: Camera, position: np.ndarray, normal: np.ndarray | None) -> np.ndarray:
    """Photo pixels a unit of area, (n,) float64; negative or zero where the surface is turned away.

    `position` (n, 3) absolute; without normals the camera is taken to look straight on.
    """
    ray = position - np.asarray(camera.centre)
    squared = np.maximum((ray * ray).sum(axis=1), TINY)
    cosine = 1.0 if normal is None else -(ray * normal).sum(axis=1) / np.sqrt(squared)
    return cosine * camera.fx_px * camera.fy_px / squared


def rank_candidates(
    position: np.ndarray,  # (n, 3) float64 absolute
    normal: np.ndarray | None,  # (n, 3)
    visible_count: np.ndarray,  # (n,)
    visible_camera: np.ndarray,  # (visible_count.sum(),)
    cameras: tuple[Camera, ...],
) -> np.ndarray:
    """The cameras that a point's visibility list names, sharpest first, (n, N_CANDIDATES) uint16, then NO_CAMERA."""
    ranked = np.full((len(position), N_CANDIDATES), NO_CAMERA, np.uint16)
    centre = np.array([c.centre for c in cameras], np.float64).reshape(-1, 3)
    scale = np.array([c.fx_px * c.fy_px for c in cameras], np.float64)
    facing = np.zeros((0, 3)) if normal is None else np.asarray(normal, np.float64)
    _rank(
        np.asarray(position, np.float64),
        facing,
        np.asarray(visible_count, np.int64),
        visible_camera,
        centre,
        scale,
        ranked,
    )
    return ranked


@kernel()
def _rank(position, normal, visible_count, visible_camera, centre, scale, ranked):
    """Fill `ranked`, a point at a time, by insertion; of equals the one listed first comes first. Sharpness as
    above."""
    held = np.empty(ranked.shape[1])
    first = 0
    for i in range(position.shape[0]):
        n_held = 0
        for camera in visible_camera[first : first + visible_count[i]]:
            x, y, z = (
                position[i, 0] - centre[camera, 0],
                position[i, 1] - centre[camera, 1],
                position[i, 2] - centre[camera, 2],
            )
            squared = max(x * x + y * y + z * z, TINY)
            cosine = 1.0
            if normal.shape[0]:
                cosine = -(x * normal[i, 0] + y * normal[i, 1] + z * normal[i, 2]) / np.sqrt(squared)
            score = cosine * scale[camera] / squared
            if np.isnan(score):
                score = 0.0
            place = n_held
            while place > 0 and held[place - 1] < score:
                place -= 1
            if place == ranked.shape[1]:
                continue
            n_held = min(n_held + 1, ranked.shape[1])
            for k in range(n_held - 1, place, -1):
                held[k], ranked[i, k] = held[k - 1], ranked[i, k - 1]
            held[place], ranked[i, place] = score, camera
        first += visible_count[i]


def best_cameras(
    cameras: tuple[Camera, ...],
    position: np.ndarray,  # (n, 3) float64 absolute
    normal: np.ndarray,  # (n, 3), either way round
    radius: float | np.ndarray,  # (n,), or one for all
    seen: np.ndarray,  # (n, n_cameras) bool
) -> np.ndarray:
    """The sharpest camera whose photo holds the whole splat, (n,) uint16; NO_CAMERA where none does.

    A camera that has only part of the splat's square serves where no other does, as long as it has its centre.
    """
    best = np.full(len(position), NO_CAMERA, np.uint16)
    best_score = np.zeros(len(position))
    radius = np.broadcast_to(radius, len(position))
    for i, camera in enumerate(cameras):
        rows = np.flatnonzero(seen[:, i])
        if not len(rows):
            continue
        score = _score(camera, position[rows], normal[rows], radius[rows])
        better = rows[score > best_score[rows]]
        best_score[better] = score[score > best_score[rows]]
        best[better] = i
    return best


def _score(camera: Camera, position: np.ndarray, normal: np.ndarray, radius: np.ndarray) -> np.ndarray:
    facing = np.abs(sharpness(camera, position, normal))
    straight = sharpness(camera, position, None)
    local = (position - np.asarray(camera.centre)) @ np.asarray(camera.rotation).T
    depth = local[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        x = local[:, 0] / depth * camera.fx_px + camera.cx_px
        y = local[:, 1] / depth * camera.fy_px + camera.cy_px
        reach = np.sqrt(2) * radius / (depth - np.sqrt(2) * radius) * max(camera.fx_px, camera.fy_px)
        edge = np.minimum(np.minimum(x, camera.width_px - x), np.minimum(y, camera.height_px - y))
        usable = (depth > 2 * radius) & (edge > 0) & (facing > STEEPEST_COSINE * straight)
        whole = edge > reach
    return np.where(usable, facing * np.where(whole, 1.0, 1e-6), 0.0)
