"""The renderer once more, slow and readable: one splat after the other, all pixels at once, in float64.

Every definition stands here in its plain form: rays against discs, sums, a division. What the shaders take from
bit streams and search for with tables, this takes from storage's own readers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from pipeline.geometry.cliplines import decode_cliplines
from pipeline.geometry.ellipsoids import decode_ellipsoids
from pipeline.geometry.frame import tangent_frames
from pipeline.splats.decoded import scene_normal_codes, scene_positions
from storage.packed.bits import unpack_bits
from storage.packed.packed import PackedScene
from storage.packed.schema import CLIPLINE_BITS, GROUP, MIP_SIZES, NO_CAMERA, Camera
from tests.reference_packed import decode_color, decode_radius, turned

NEAR_IN_RADII = 0.01
ROUNDING = 1e-5
LEAST_WEIGHT = 1 / 1024
HIDES, HIDES_PX2 = 0.7, 0.25  # squared distances, in radii and in px, up to which a splat hides what lies behind it
SNAPPED_PX = (
    1 / 512
)  # how far rasterisers move a corner at most: GPUs round to 8 bits below a pixel, llvmpipe shades as if it did not
ATOM_AREA = 0.5 * 16 * 16  # half a level finer than one texel a pixel


@dataclass(frozen=True)
class Discs:
    """Splats in the axes of a camera."""

    centre: np.ndarray  # (n, 3)
    u: np.ndarray  # (n, 3) one radius long
    v: np.ndarray  # (n, 3)


@dataclass(frozen=True)
class Fragments:
    """The pixels of one splat; rows correspond."""

    pixel: np.ndarray  # (m,) index in the flattened picture
    x: np.ndarray  # (m,) on the disc, in radii
    y: np.ndarray
    d2: np.ndarray
    z: np.ndarray
    pushed_z: np.ndarray
    hides: np.ndarray  # (m,) bool
    area_px: float  # None where the splat is too close for it
    ball: np.ndarray | None = (
        None  # (m, 3) of an ellipsoid: where it is hit, in its own axes, as a point of the unit ball
    )


def render(scene: PackedScene, view: Camera, max_atoms: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """Picture (h, w, 3) in [0, 1], sRGB, and coverage (h, w)."""
    atom, weight_code = scene.codes()
    header = scene.header
    finest = MIP_SIZES.index(header.atom_size)

    @cache
    def levels_of(index: int, turn: int) -> list[np.ndarray]:
        return [turned(scene.arrays[f"atoms_{size}"][index].astype(np.float64), turn) for size in header.mip_sizes]

    average = averages_of(scene)

    def color(splat: int, fragments: Fragments) -> np.ndarray:
        level = mip_level(ATOM_AREA, fragments.area_px, 5)
        if "level_blending" not in header.effects:
            level = float(np.floor(level + 0.45))
        total = np.tile(average[splat], (len(fragments.x), 1))
        ranks = range(scene.n_atoms[splat])
        sizes = [-abs(scene.arrays["weight_levels"][rank, weight_code[splat, rank]]) for rank in ranks]
        for rank in sorted(ranks, key=lambda rank: sizes[rank])[:max_atoms]:
            index, turn = divmod(atom[splat, rank], header.n_turns)
            weight = scene.arrays["weight_levels"][rank, weight_code[splat, rank]] * scene.arrays["atom_scale"][index]
            places = (fragments.x, fragments.y) if fragments.ball is None else fragments.ball.T[:2]
            x, y = (texel_of(at, header.atom_size) for at in places)
            total += float(weight) * sample(levels_of(int(index), int(turn)), x, y, max(level - finest, 0))
        return np.clip(total, 0, 1)

    return blend(scene, view, color)


def render_baseline(scene: PackedScene, photos: list[np.ndarray], view: Camera) -> tuple[np.ndarray, np.ndarray]:
    """The same, with colours from the photos, (h, w, 3) uint8 each."""
    header = scene.header
    camera_of = scene.arrays.get("camera", np.full(header.n_splats, NO_CAMERA))
    pyramids = [box_pyramid(photo / 255.0) for photo in photos]
    discs = [discs_of(scene, camera) for camera in header.cameras]
    balls = [ellipsoids_of(scene, camera) for camera in header.cameras]
    average = averages_of(scene)

    def color(splat: int, fragments: Fragments) -> np.ndarray:
        index = camera_of[splat]
        if index == NO_CAMERA:
            return np.tile(average[splat], (len(fragments.x), 1))
        camera, disc = header.cameras[index], discs[index]
        if fragments.ball is not None:
            axes = balls[index][splat]
            disc = Discs(disc.centre, np.tile(axes[0], (len(disc.u), 1)), np.tile(axes[1], (len(disc.v), 1)))
        image = image_of(disc, splat, camera)
        level = mip_level(abs(np.linalg.det(image)), fragments.area_px, len(pyramids[index]) - 1)
        x, y = np.clip(fragments.x, -1, 1)[:, None], np.clip(fragments.y, -1, 1)[:, None]
        point = disc.centre[splat] + (
            x * disc.u[splat] + y * disc.v[splat] if fragments.ball is None else fragments.ball @ axes
        )
        px_x = camera.fx_px * point[:, 0] / point[:, 2] + camera.cx_px
        px_y = camera.fy_px * point[:, 1] / point[:, 2] + camera.cy_px
        return sample(pyramids[index], px_x, px_y, level)

    return blend(scene, view, color)


def averages_of(scene: PackedScene) -> np.ndarray:
    """(n, 3) sRGB, 255 is 1.0."""
    return np.array([decode_color(scene, splat) for splat in range(scene.header.n_splats)])


def radii_of(scene: PackedScene) -> np.ndarray:
    return np.array([decode_radius(scene, splat) for splat in range(scene.header.n_splats)])


def blend(scene: PackedScene, view: Camera, color) -> tuple[np.ndarray, np.ndarray]:
    header = scene.header
    discs, lines = discs_of(scene, view), cliplines_of(scene)
    axes, radius = ellipsoids_of(scene, view), radii_of(scene)
    drawn = [
        ellipsoid_fragments(
            discs.centre[splat], axes[splat], view, radius[splat], header.margin_radii, NEAR_IN_RADII * header.radius
        )
        if splat in axes
        else fragments_of(
            discs, splat, lines[splat], view, radius[splat], header.margin_radii, NEAR_IN_RADII * header.radius
        )
        for splat in range(header.n_splats)
    ]
    n_pixels = view.width_px * view.height_px
    nearest = np.full(n_pixels, np.inf)
    for fragments in drawn:
        np.minimum.at(nearest, fragments.pixel[fragments.hides], fragments.pushed_z[fragments.hides])
    sums, weights = np.zeros((n_pixels, 3)), np.zeros(n_pixels)
    for splat, fragments in enumerate(drawn):
        if len(fragments.pixel):
            weight = (1 - fragments.d2) * (fragments.z <= nearest[fragments.pixel])
            np.add.at(sums, fragments.pixel, to_linear(color(splat, fragments)) * weight[:, None])
            np.add.at(weights, fragments.pixel, weight)
    covered = weights >= LEAST_WEIGHT
    picture = np.zeros((n_pixels, 3))
    picture[covered] = to_srgb(np.clip(sums[covered] / weights[covered, None], 0, 1))
    shape = view.height_px, view.width_px
    return picture.reshape(*shape, 3), covered.reshape(shape)


def discs_of(scene: PackedScene, view: Camera) -> Discs:
    header, position = scene.header, scene_positions(scene)
    u, v, _ = tangent_frames(scene_normal_codes(scene), header.up, header.ahead)
    to_camera = np.array(view.rotation).T
    eye = np.subtract(view.centre, header.origin)
    radius = radii_of(scene)[:, None]
    return Discs((position - eye) @ to_camera, radius * u @ to_camera, radius * v @ to_camera)


def cliplines_of(scene: PackedScene) -> np.ndarray:
    """(n, 3); 0 x + 0 y + 1 where there is none."""
    lines = np.tile([0.0, 0.0, 1.0], (scene.header.n_splats, 1))
    has_line = np.flatnonzero(scene.rows.clipline >= 0)
    if len(has_line):
        first_word = scene.arrays["clipline_word"].astype(np.int64)[has_line // GROUP]
        first_bit = first_word * 32 + scene.rows.clipline[has_line] * CLIPLINE_BITS
        lines[has_line] = decode_cliplines(unpack_bits(scene.arrays["cliplines"], first_bit, CLIPLINE_BITS))
    return lines


def ellipsoids_of(scene: PackedScene, view: Camera) -> dict[int, np.ndarray]:
    """Half axes as rows (3, 3) in the axes of a camera, by splat."""
    found = {}
    for splat in np.flatnonzero(scene.rows.extra["ellipsoid"] >= 0):
        word = scene.arrays["ellipsoids"][
            scene.arrays["ellipsoid_word"][splat // GROUP] + scene.rows.extra["ellipsoid"][splat]
        ]
        fields = np.frombuffer(word.tobytes(), np.uint8)[None]
        header, normal = scene.header, scene_normal_codes(scene)[splat : splat + 1]
        radius = decode_radius(scene, int(splat))
        found[int(splat)] = (
            decode_ellipsoids(fields, normal, header.up, header.ahead, radius)[0] @ np.array(view.rotation).T
        )
    return found


def ellipsoid_fragments(
    centre: np.ndarray, axes: np.ndarray, view: Camera, radius: float, margin_radii: float, near: float
) -> Fragments:
    """Rays against the surface: the smaller root of a quadratic, where the ellipsoid is the unit ball."""
    px = pixels_of(view)
    ray = rays_of(px, view)
    to_ball = np.linalg.inv(axes)  # of rows: p @ to_ball
    eye, step = -centre @ to_ball, ray @ to_ball
    distance = np.linalg.norm(eye)
    if distance <= 1:
        return Fragments(*np.zeros((6, 0)).astype(int), np.zeros(0, bool), None)
    pole = centre + (eye / distance) @ axes
    x = np.linalg.svd(eye[None])[2][1]  # any two directions across the eye's
    y = np.cross(eye / distance, x)
    rim = np.sqrt((distance - 1) / (distance + 1))
    outline = Discs(pole[None], (rim * x @ axes)[None], (rim * y @ axes)[None])
    small, area_px = False, None
    if pole[2] > 2 * np.hypot(np.linalg.norm(outline.u), np.linalg.norm(outline.v)):
        image = image_of(outline, 0, view)
        area_px = abs(np.linalg.det(image))
        small = np.linalg.svd(image, compute_uv=False)[1] < 1
    margin = margin_of(pole[2], radius, margin_radii, view)
    if small:
        return _small_ellipsoid(outline, distance, np.stack([x, y, eye / distance]), view, image, area_px, near, margin)
    a, b, c = (step**2).sum(axis=1), step @ eye, distance**2 - 1
    with np.errstate(invalid="ignore"):
        z = (-b - np.sqrt(b**2 - a * c)) / a
        tangent = np.linalg.norm(np.cross(step, eye), axis=1) / -b  # of the angle between the ray and the centre
        d2 = tangent**2 * c
        kept = (b < 0) & (d2 < 1) & (z > 0) & (_disc_depth(outline, ray) >= near)
    pixel = np.flatnonzero(kept)
    ball = eye + z[pixel, None] * step[pixel]
    pushed_z = z[pixel] * (1 + margin / np.linalg.norm(pole) + ROUNDING)
    hides = d2[pixel] < HIDES
    return Fragments(pixel, *np.zeros((2, len(pixel))), d2[pixel], z[pixel], pushed_z, hides, area_px, ball)


def _disc_depth(disc: Discs, ray: np.ndarray) -> np.ndarray:
    normal = np.cross(disc.u[0], disc.v[0])
    return (disc.centre[0] @ normal) / (ray @ normal)


def _small_ellipsoid(outline, distance, facing, view, image, area_px, near, margin) -> Fragments:
    """An outline below a pixel somewhere is drawn as a disc is, at the depth of the point that faces the eye."""
    offset = pixels_of(view) - ray_to_px(outline.centre[0], view)
    left, half_axes, right = np.linalg.svd(image)
    on_disc = ((offset @ left) / np.maximum(half_axes, 1e-3)) @ right
    d2, hides = _nearness(on_disc, offset)
    pixel = np.flatnonzero((d2 < 1) & (outline.centre[0, 2] >= near))
    on_disc, d2, hides = on_disc[pixel], d2[pixel], hides[pixel]
    on_disc /= np.maximum(np.linalg.norm(on_disc, axis=1, keepdims=True), 1)
    k = np.sqrt(1 - (on_disc**2).sum(axis=1).clip(0, 1))
    seen = np.column_stack([on_disc * np.sqrt(distance**2 - 1), 1 + distance * k]) / (distance + k)[:, None]
    z = outline.centre[0, 2] * (distance + 1) / (distance + np.sqrt(1 - d2))
    pushed_z = z * (1 + margin / np.linalg.norm(outline.centre[0]) + ROUNDING)
    return Fragments(pixel, on_disc[:, 0], on_disc[:, 1], d2, z, pushed_z, hides, area_px, seen @ facing)


def pixels_of(view: Camera) -> np.ndarray:
    column, row = np.meshgrid(np.arange(view.width_px) + 0.5, np.arange(view.height_px) + 0.5)
    return np.stack([column.ravel(), row.ravel()], axis=1)


def rays_of(px: np.ndarray, view: Camera) -> np.ndarray:
    return np.column_stack([(px - [view.cx_px, view.cy_px]) / [view.fx_px, view.fy_px], np.ones(len(px))])


def image_of(discs: Discs, splat: int, view: Camera) -> np.ndarray:
    """(2, 2): how the projected px moves with x and y on the disc, at its centre."""
    centre = discs.centre[splat]
    focal = np.array([view.fx_px, view.fy_px])
    columns = [
        focal * (axis[:2] - centre[:2] / centre[2] * axis[2]) / centre[2] for axis in (discs.u[splat], discs.v[splat])
    ]
    return np.stack(columns, axis=1)


def fragments_of(
    discs: Discs, splat: int, line: np.ndarray, view: Camera, radius: float, margin_radii: float, near: float
) -> Fragments:
    px = pixels_of(view)
    centre, u, v = discs.centre[splat], discs.u[splat], discs.v[splat]
    ray = rays_of(px, view)
    area_px = None
    small = False
    if centre[2] > 2 * radius:
        image = image_of(discs, splat, view)
        area_px = abs(np.linalg.det(image))
        small = np.linalg.svd(image, compute_uv=False)[1] < 1
    if small:
        offset = px - (ray_to_px(centre, view))
        left, half_axes, right = np.linalg.svd(image)
        on_disc = ((offset @ left) / np.maximum(half_axes, 1e-3)) @ right
        d2, hides = _nearness(on_disc, offset)
        z = np.full(len(px), centre[2])
    else:
        normal = np.cross(u, v)
        with np.errstate(divide="ignore", invalid="ignore"):
            z = (centre @ normal) / (ray @ normal)
            offset = ray * z[:, None] - centre
            on_disc = np.stack([offset @ u, offset @ v], axis=1) / radius**2
            d2 = (on_disc**2).sum(axis=1)
            hides = d2 < HIDES
    with np.errstate(invalid="ignore"):
        kept = (d2 < 1) & (z >= near) & (on_disc @ line[:2] + line[2] >= 0)
    pixel = np.flatnonzero(kept)
    z, on_disc = z[pixel], on_disc[pixel]
    pushed_z = z * (1 + margin_of(centre[2], radius, margin_radii, view) / np.linalg.norm(centre) + ROUNDING)
    return Fragments(pixel, on_disc[:, 0], on_disc[:, 1], d2[pixel], z, pushed_z, hides[pixel], area_px)


def margin_of(z: float, radius: float, margin_radii: float, view: Camera) -> float:
    """How far a splat is pushed back; one below a pixel is drawn as wide as one."""
    return margin_radii * max(radius, z / min(view.fx_px, view.fy_px))


def _nearness(on_disc: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Squared distance and whether it hides what lies behind, by places on the disc in radii and on the screen in px."""
    in_radii, in_px = (on_disc**2).sum(axis=1), (offset**2).sum(axis=1)
    return np.minimum(in_radii, in_px), (in_radii < HIDES) | (in_px < HIDES_PX2)


def ray_to_px(point: np.ndarray, view: Camera) -> np.ndarray:
    return np.array([view.fx_px, view.fy_px]) * point[:2] / point[2] + [view.cx_px, view.cy_px]


def mip_level(area_texels: float, area_px: float | None, last: int) -> float:
    if area_px is None:
        return 0.0
    return float(np.clip(0.5 * np.log2(area_texels / max(area_px, 0.25)), 0, last))


def texel_of(on_disc: np.ndarray, size: int) -> np.ndarray:
    return (np.clip(on_disc, -1, 1) + 1) * size / 2


def sample(levels: list[np.ndarray], x: np.ndarray, y: np.ndarray, level: float) -> np.ndarray:
    """Texels at x, y of the finest level, between two levels of a pyramid; the edge goes on for ever."""
    finer = int(level)
    values = bilinear(levels[finer], x, y, len(levels[0]))
    if level > finer:
        values += (level - finer) * (bilinear(levels[finer + 1], x, y, len(levels[0])) - values)
    return values


def bilinear(texels: np.ndarray, x: np.ndarray, y: np.ndarray, finest_height: int) -> np.ndarray:
    height, width = texels.shape[:2]
    scale = height / finest_height
    x, y = np.clip(x * scale - 0.5, 0, width - 1), np.clip(y * scale - 0.5, 0, height - 1)
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    fx, fy = (x - left)[:, None], (y - top)[:, None]
    upper = texels[top, left] * (1 - fx) + texels[top, right] * fx
    return upper * (1 - fy) + (texels[bottom, left] * (1 - fx) + texels[bottom, right] * fx) * fy


def box_pyramid(photo: np.ndarray) -> list[np.ndarray]:
    """Means of 2 x 2, as far as sides are even."""
    levels = [photo]
    while all(side % 2 == 0 for side in levels[-1].shape[:2]):
        height, width = levels[-1].shape[:2]
        levels.append(levels[-1].reshape(height // 2, 2, width // 2, 2, 3).mean(axis=(1, 3)))
    return levels


def to_linear(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: np.ndarray) -> np.ndarray:
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


def psnr_db(a: np.ndarray, b: np.ndarray) -> float:
    return 10 * np.log10(1 / max(np.mean((a - b) ** 2), 1e-20))


def agreement_db(
    rgb: np.ndarray, expected: np.ndarray, twin: Callable[[Camera], np.ndarray], view: Camera, enough_db: float = 45
) -> float:
    """PSNR of a picture, uint8, against the one that the twin drew of `view`. Where it is not enough each pixel is
    compared with the nearest of five: the twin's picture, and it once more with the picture moved by SNAPPED_PX to each
    of four sides. For a splat's rim that crosses a pixel's centre within that distance may hide what lies behind it
    there, or not, on a rasteriser that rounds corners."""
    shown, s = rgb / 255, SNAPPED_PX
    found = psnr_db(shown, expected)
    if found >= enough_db:
        return found
    moved = [twin(replace(view, cx_px=view.cx_px + x, cy_px=view.cy_px + y)) for x in (-s, s) for y in (-s, s)]
    error = np.min([((shown - picture) ** 2).sum(axis=-1) for picture in (expected, *moved)], axis=0)
    return float(10 * np.log10(1 / max(error.mean() / 3, 1e-20)))
