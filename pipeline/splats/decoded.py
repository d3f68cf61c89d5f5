"""Splats as the renderer will decode them, and the cameras that see them, read from the folders of their stages."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.geometry.ellipsoids import decode_ellipsoids, squares_of
from pipeline.geometry.frame import Direction, tangent_frames
from pipeline.geometry.positions import Boxes, decode_positions
from pipeline.geometry.quadrics.frames import decode_quadrics, frames_of_arrays
from pipeline.geometry.sizes import Scales, cells_of, decode_sizes
from pipeline.splats.visibility import seen_points
from storage.packed.scene import PackedScene
from storage.packed.schema import BOXES, CHUNK, FRAMES, QUADRICS, Camera
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
    """Middles and tangents (n, 3) of the squares that the splats of a block of whole chunks are textured on, and their
    radii (n,), which the tangents are in; `radius` is that of all, or what their sizes are steps of."""
    radii = splat_radii(splats, radius, start, stop)
    normal_code = decoded_normals(splats, start, stop)
    centre, (u, v, _) = decoded_centres(splats, start, stop), tangent_frames(normal_code, up, ahead)
    if arrays.exists(splats, "has_ellipsoid"):
        has = np.flatnonzero(arrays.read(splats, "has_ellipsoid", start, stop))
        axes = decode_ellipsoids(
            arrays.read(splats, "ellipsoid", start, stop)[has], normal_code[has], up, ahead, radii[has]
        )
        centre, u, v = squares_of(centre, u, v, has, axes, radii[has])
    return centre, (u, v), radii


def splat_radii(folder: Path | None, radius: float, start: int, stop: int) -> np.ndarray:
    """The radii (n,) float64 of the splats of a block of whole chunks, by the size_code and size_scale of a stage's
    folder; where there are none the one `radius` of all."""
    if folder is None or not arrays.exists(folder, "size_code"):
        return np.full(stop - start, radius)
    return decode_sizes(*read_sizes(folder, radius, start, stop))


def read_sizes(folder: Path, radius: float, start: int, stop: int) -> tuple[np.ndarray, Scales]:
    """Codes (n,) uint8 and scales of the splats of a block of whole chunks."""
    step, cells = (
        arrays.read(folder, name, start // CHUNK, -(-stop // CHUNK)) for name in ("size_scale", "size_cells")
    )
    return arrays.read(folder, "size_code", start, stop), Scales(step, radius, cells)


def scene_radii(scene: PackedScene) -> np.ndarray:
    """The radii (n,) float64 of the splats of a packed file."""
    header = scene.header
    if not header.size_bits:
        return np.full(header.n_splats, header.radius)
    step = scene.arrays["size_scale"]
    cells = cells_of(step, None if header.geometry == QUADRICS else header.size_bits)
    return decode_sizes(scene.size_codes, Scales(step, header.radius, cells))


def scene_positions(scene: PackedScene) -> np.ndarray:
    """Where the splats of a packed file lie, (n, 3) float64 against the origin."""
    if scene.header.geometry != BOXES:
        return _decoded_splats(scene)[0].astype(np.float64)
    arrays = scene.arrays
    position = arrays["position"].astype(np.uint32)
    code = position[:, 0] | position[:, 1] << 8 | position[:, 2] << 16
    return decode_positions(code, Boxes(arrays["box_low"], arrays["box_size"], arrays["box_bits"]))


def scene_normal_codes(scene: PackedScene) -> np.ndarray:
    """The octahedral normals (n, 2) int8 of the splats of a packed file; over quadrics points of octahedra (n, 3) int16."""
    return scene.arrays["normal"] if scene.header.geometry == BOXES else _decoded_splats(scene)[1]


def scene_bounds(scene: PackedScene) -> tuple[np.ndarray, np.ndarray]:
    """Low and high corner (c, 3) float64 against the origin of a box that holds the centres of each chunk."""
    if scene.header.geometry != BOXES:
        low, high = _bounds_of(_decoded_splats(scene)[0])
        return low.astype(np.float64), high.astype(np.float64)
    low = scene.arrays["box_low"].astype(np.float64)
    return low, low + scene.arrays["box_size"]


def _bounds_of(position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Low and high corner (c, 3) float32 of the splats of each chunk."""
    starts = np.arange(0, len(position), CHUNK)
    return np.minimum.reduceat(position, starts), np.maximum.reduceat(position, starts)


def _decoded_splats(scene: PackedScene) -> tuple[np.ndarray, np.ndarray]:
    """Positions and normals of runs or quadrics, decoded once a scene: every reader of a file asks for them."""
    if "splats" not in scene.decoded:
        if scene.header.runs:
            from pipeline.splats.runs import decoded_splats  # loops that compile: for runs alone

            scene.decoded["splats"] = decoded_splats(scene)
        else:
            scene.decoded["splats"] = decode_quadrics(scene.numbers, frames_of_arrays(scene.arrays))
    return scene.decoded["splats"]


def decoded_normals(splats: Path, start: int, stop: int) -> np.ndarray:
    """Octahedral codes (n, 2) of a block of whole chunks, over quadrics points of octahedra (n, 3)."""
    name = "normal_point" if arrays.exists(splats, "normal_point") else "normal_code"
    return arrays.read(splats, name, start, stop)


def decoded_centres(splats: Path, start: int, stop: int) -> np.ndarray:
    """What the renderer will make of the positions of a block of whole chunks, (n, 3) float64 against the origin."""
    if arrays.exists(splats, "centre"):
        return arrays.read(splats, "centre", start, stop).astype(np.float64)
    chunks = slice(start // CHUNK, -(-stop // CHUNK))
    if arrays.exists(splats, FRAMES[0]):
        named = [name for name in (*FRAMES, "frame_box", "size_scale") if arrays.exists(splats, name)]
        frames = {name: arrays.read(splats, name, chunks.start, chunks.stop) for name in named}
        return decode_quadrics(arrays.read(splats, "number", start, stop), frames_of_arrays(frames))[0]
    boxes = Boxes(
        *(arrays.read(splats, name, chunks.start, chunks.stop) for name in ("box_low", "box_size", "box_bits"))
    )
    return decode_positions(arrays.read(splats, "position_code", start, stop), boxes)
