"""Splats as the renderer will decode them, and the cameras that see them, read from the folders of their stages."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.geometry.ellipsoids import decode_ellipsoids, squares_of
from pipeline.geometry.frame import Direction, tangent_frames
from pipeline.geometry.positions import Boxes, decode_positions
from pipeline.geometry.sizes import Scales, decode_sizes
from pipeline.splats.visibility import seen_points
from storage.packed.scene import PackedScene
from storage.packed.schema import CHUNK, Camera
from storage.work import arrays


def seen_by_cameras(
    partition: Path,
    depth_maps: Path | None,
    cameras: tuple[Camera, ...],
    absolute: np.ndarray,  # (n, 3)
    normal: np.ndarray,  # (n, 3), either way round
    radius: np.ndarray,  # (n,)
    start: int,
    stop: int,
) -> np.ndarray:
    """Which cameras see the splats start..stop, (n, n_cameras) bool: by their visibility lists, else by depth maps."""
    seen = np.zeros((stop - start, len(cameras) + 1), bool)  # the last column takes what stands for no camera
    if depth_maps is not None:
        for i, camera in enumerate(cameras):
            depth_map = arrays.read(depth_maps, f"depth_{i}")
            seen[:, i] = seen_points(depth_map, camera, absolute, normal, radius)
    elif cameras:
        candidate = arrays.read(partition, "candidate", start, stop).astype(np.int64)
        np.put_along_axis(seen, np.minimum(candidate, len(cameras)), True, axis=1)
    return seen[:, : len(cameras)]


def decoded_squares(
    splats: Path, up: Direction, ahead: Direction, radius: float, start: int, stop: int
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Middles and tangents (n, 3) of the squares that the splats of a block of whole chunks are textured on, and their radii
    (n,), which the tangents are in; `radius` is that of all, or what their sizes are steps of."""
    radii = splat_radii(splats, radius, start, stop)
    normal_code = arrays.read(splats, "normal_code", start, stop)
    centre, (u, v, _) = decoded_centres(splats, start, stop), tangent_frames(normal_code, up, ahead)
    if arrays.exists(splats, "has_ellipsoid"):
        has = np.flatnonzero(arrays.read(splats, "has_ellipsoid", start, stop))
        axes = decode_ellipsoids(
            arrays.read(splats, "ellipsoid", start, stop)[has], normal_code[has], up, ahead, radii[has]
        )
        centre, u, v = squares_of(centre, u, v, has, axes, radii[has])
    return centre, (u, v), radii


def splat_radii(folder: Path | None, radius: float, start: int, stop: int) -> np.ndarray:
    """The radii (n,) float64 of the splats of a block of whole chunks, by the size_code and size_scale of a stage's folder; where
    there are none the one `radius` of all."""
    if folder is None or not arrays.exists(folder, "size_code"):
        return np.full(stop - start, radius)
    step = arrays.read(folder, "size_scale", start // CHUNK, -(-stop // CHUNK))
    return decode_sizes(arrays.read(folder, "size_code", start, stop), Scales(step, radius))


def scene_radii(scene: PackedScene) -> np.ndarray:
    """The radii (n,) float64 of the splats of a packed file."""
    header = scene.header
    if not header.size_bits:
        return np.full(header.n_splats, header.radius)
    return decode_sizes(scene.size_codes, Scales(scene.arrays["size_scale"], header.radius, header.size_bits))


def decoded_centres(splats: Path, start: int, stop: int) -> np.ndarray:
    """What the renderer will make of the positions of a block of whole chunks, (n, 3) float64 against the origin."""
    chunks = slice(start // CHUNK, -(-stop // CHUNK))
    boxes = Boxes(
        *(arrays.read(splats, name, chunks.start, chunks.stop) for name in ("box_low", "box_size", "box_bits"))
    )
    return decode_positions(arrays.read(splats, "position_code", start, stop), boxes)
