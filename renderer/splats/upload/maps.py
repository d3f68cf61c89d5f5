"""The maps of a scene in GPU memory: colours with mip levels and depth codes, a layer of a texture array each.

A layer has a map's six squares, three in a row: bottom cap, top cap, and the band in quarters; station_map.glsl finds
them. So no layer is wider than three heights. Coarser levels of colours stand side by side below the finest: lookups
take texels one by one, as each has its own depth to test, so GL's own levels would serve nothing. Layers are as large
as the largest map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import moderngl
import numpy as np

from pipeline.geometry.ellipsoids import LONGEST_RADII
from pipeline.maps.stored import VOID, decode_codes, decode_colors, halved
from pipeline.splats.decoded import scene_bounds, scene_positions, scene_radii
from storage.errors import ResourceExhausted
from storage.maps import IN_PART, NO_MAP
from storage.packed.batches import CHUNKS_PER_GROUP
from storage.packed.packed import PackedScene
from storage.packed.schema import CHUNK, Camera, Header

MIP_LEVELS = 5  # of colours, as MAP_ROWS lets heights be halved
COLORS_UNIT, DEPTHS_UNIT = 1, 2  # station_map.glsl says the same
# From which radius on the screen a splat is looked up; shaders/looked_up.glsl says the same, and why.
TEXELS_A_PX, SMALLEST_LOOKED_UP_PX, ALWAYS_LOOKED_UP_PX = 2.0, 2.5, 16.0
ROUNDING = 1e-3  # of float32: so much farther off a splat is taken to be looked up


@dataclass(frozen=True)
class MapsInView:
    """Tells which groups have splats that a view looks up in their maps: those that show a scan from afar have few, and
    programs without maps draw the others several times as fast."""

    low: np.ndarray  # (c, 3) corners of chunks against the origin, centres of splats in them
    high: np.ndarray
    radius: np.ndarray  # (c,) of the largest splat
    farthest: np.ndarray  # (c,) focal lengths of a pixel off, from which on none of its splats is looked up

    def looked_up(self, view: Camera, origin: Sequence[float]) -> np.ndarray:
        """(n_groups,) bool: a splat that reaches before the view's plane may be."""
        ahead = np.array(view.rotation[2])
        eye = (np.array(view.centre) - origin) @ ahead
        nearest = (np.where(ahead > 0, self.low, self.high) * ahead).sum(axis=1) - eye
        deepest = (np.where(ahead > 0, self.high, self.low) * ahead).sum(axis=1) - eye
        focal = max(view.fx_px, view.fy_px)
        some = (self.farthest > 0) & (self.farthest * focal > nearest) & (deepest > -LONGEST_RADII * self.radius)
        return np.logical_or.reduceat(some, np.arange(0, len(some), CHUNKS_PER_GROUP))


def maps_in_view(scene: PackedScene) -> MapsInView:
    """Of a scene with maps."""
    header, station, position = scene.header, scene.arrays["station"], scene_positions(scene)
    radius, farthest = scene_radii(scene), np.zeros(header.n_splats)
    for i, stored in enumerate(header.maps):
        its = np.flatnonzero((station % IN_PART == i) & (station != NO_MAP))
        away = np.linalg.norm(position[its] - np.subtract(stored.centre, header.origin), axis=1)
        texels = radius[its] / np.maximum(away, 1e-30) * stored.height_px * 2 / np.pi
        from_px = np.clip(texels / TEXELS_A_PX, SMALLEST_LOOKED_UP_PX, ALWAYS_LOOKED_UP_PX)
        farthest[its] = (1 + ROUNDING) * radius[its] / from_px
    starts = np.arange(0, header.n_splats, CHUNK)
    largest = (np.maximum.reduceat(of, starts) for of in (radius, farthest))
    return MapsInView(*scene_bounds(scene), *largest)


@dataclass
class GpuMaps:
    """The texture arrays of a scene's maps, a layer a map, and the bytes that they take."""

    colors: moderngl.TextureArray
    depths: moderngl.TextureArray
    n_bytes: int

    def use(self) -> None:
        self.colors.use(COLORS_UNIT)
        self.depths.use(DEPTHS_UNIT)

    def release(self) -> None:
        self.colors.release()
        self.depths.release()


def map_frames(header: Header) -> np.ndarray:
    """(n_maps, 9) float32: the station against the origin as two floats, height, 1 / nearest, codes an e-fold; see
    map_of_splat.glsl."""
    rows = np.empty((len(header.maps), 9), np.float32)
    for row, stored in zip(rows, header.maps, strict=True):
        centre = np.subtract(stored.centre, header.origin, dtype=np.float64)
        row[:3] = centre
        row[3:6] = centre - row[:3]
        row[6:] = stored.height_px, 1 / stored.nearest, 1 / stored.depth_step
    return rows


def upload_maps(context: moderngl.Context, scene: PackedScene) -> GpuMaps:
    """The textures of a scene's maps.

    Raises: InvalidPackedFile for a picture that is none, ResourceExhausted where they are too large for the GPU.
    """
    maps = scene.header.maps
    height = max(stored.height_px for stored in maps)
    _check_limits(context, height, len(maps))
    colors = context.texture_array((3 * height, 3 * height, len(maps)), 4)
    depths = context.texture_array((3 * height, 2 * height, len(maps)), 1, dtype="u2")
    colors.filter = depths.filter = moderngl.NEAREST, moderngl.NEAREST
    at_color = at_texel = 0
    for layer, stored in enumerate(maps):
        color = scene.arrays["map_colors"][at_color : at_color + stored.color_bytes]
        low, high = (
            scene.arrays[name][at_texel : at_texel + stored.n_texels].reshape(stored.height_px, -1)
            for name in ("map_depth_low", "map_depth_high")
        )
        at_color, at_texel = at_color + stored.color_bytes, at_texel + stored.n_texels
        codes = decode_codes(low, high)
        _write(depths, in_squares(codes[..., None]), layer)
        levels = color_levels(decode_colors(stored, color, scene.header.scan.get("name") or "packed file"), codes)
        for level, picture in enumerate(levels):
            _write(colors, in_squares(picture), layer, level_corner(stored.height_px, level))
    return GpuMaps(colors, depths, len(maps) * (9 * height**2 * 4 + 6 * height**2 * 2))


def color_levels(color: np.ndarray, codes: np.ndarray) -> list[np.ndarray]:
    """The mip levels (h, 6 h, 4) uint8 of a map's colours, the finest first; alpha is the share of a texel that shows a
    surface, and colours are the means of that."""
    mean, share = color.astype(np.float32), (codes != VOID).astype(np.float32)
    levels = []
    for level in range(MIP_LEVELS):
        if level:
            mean, share = halved(mean, share)
        levels.append(np.rint(np.concatenate([mean, 255 * share[..., None]], axis=2)).astype(np.uint8))
    return levels


def in_squares(picture: np.ndarray) -> np.ndarray:
    """A map (h, 6 h, k) as (2 h, 3 h, k): its squares, three in a row."""
    height, _, k = picture.shape
    squares = picture.reshape(height, 2, 3 * height, k).swapaxes(0, 1)
    return np.ascontiguousarray(squares).reshape(2 * height, 3 * height, k)


def level_corner(height: int, level: int) -> tuple[int, int]:
    """Column and row where a level of colours begins in its layer; station_map.glsl computes the same."""
    return (3 * height - (3 * height >> (level - 1)), 2 * height) if level else (0, 0)


def _check_limits(context: moderngl.Context, height: int, n_maps: int) -> None:
    side, layers = context.info["GL_MAX_TEXTURE_SIZE"], context.info["GL_MAX_ARRAY_TEXTURE_LAYERS"]
    if 3 * height > side or n_maps > layers:
        raise ResourceExhausted(
            "textures of station maps",
            f"{n_maps} layers of {3 * height} x {3 * height} texels",
            f"{layers} layers of {side} texels to a side with {context.info['GL_RENDERER']}",
            "compress with --texture atoms",
        )


def _write(texture: moderngl.TextureArray, picture: np.ndarray, layer: int, corner: tuple[int, int] = (0, 0)) -> None:
    height, width = picture.shape[:2]
    texture.write(picture.tobytes(), viewport=(*corner, layer, width, height, 1))
