"""Which splats a view shows, and which page of its photograph each wants.

A small picture of splat numbers, drawn by a depth buffer of squares as wide as the splats: the places of pages,
not their colours. It stands for the feedback buffer of the renderer where paths are simulated, and for the second,
small rendering that pages are predicted by.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.execution.compiled import kernel
from renderer.residency.feedback import FAR, Feedback
from storage.packed.schema import NO_CAMERA, Camera
from storage.pages.layout import PageLayout

NEAR = 1e-3  # of a view's focal length in splat radii: nearer splats are behind the viewer, to us
LEAST_COSINE = 0.05  # of discs seen from their edge
MOST_SQUARE_PX = 64  # half the side of a splat's square


@dataclass(frozen=True)
class Pose:
    """Where a viewer is and looks: world to camera, x right, y down, z ahead, as `Camera` has it."""

    rotation: np.ndarray  # (3, 3)
    centre: np.ndarray  # (3,)


@dataclass(frozen=True)
class Screen:
    """What a viewer looks through: a picture of width x height pixels, and its focal length."""

    width_px: int
    height_px: int
    focal_px: float


@dataclass(frozen=True)
class Places:
    """Splats with the places of their middles in their photographs, magnified `magnified` times."""

    centre: np.ndarray  # (n, 3) float64
    radius: np.ndarray  # (n,) float64
    normal: np.ndarray  # (n, 3), either way round
    photo: np.ndarray  # (n,) int64; rows without a photograph are left out
    x: np.ndarray  # (n,) pixels of the finest level
    y: np.ndarray  # (n,)
    octaves: np.ndarray  # (n,) log2 of photo pixels a unit of length, mean over the splat's disc
    layout: PageLayout

    def seen(self, pose: Pose, screen: Screen, halving: int, shift: tuple[float, float] = (0.0, 0.0)) -> Seen:
        """What a view shows. The picture is `halving` times smaller than the screen; its middle lies `shift` pixels
        beside the optical axis (a generalised frustum)."""
        scale = screen.focal_px / halving
        width, height = screen.width_px // halving, screen.height_px // halving
        middle = width / 2 - shift[0] / halving, height / 2 - shift[1] / halving
        shown = np.full((height, width), -1, np.int32)
        nearest = np.full((height, width), np.inf, np.float32)
        draw_squares(self.centre, self.radius, pose.rotation, pose.centre, scale, *middle, nearest, shown)
        return Seen(self, shown, pose, screen, halving)


@dataclass(frozen=True)
class Seen:
    """A picture of splat numbers, -1 where nothing is."""

    places: Places
    splat: np.ndarray  # (height, width) int32
    pose: Pose
    screen: Screen
    halving: int

    @property
    def n_pixels(self) -> float:
        """Pixels of the screen that show a splat."""
        return float((self.splat >= 0).sum()) * self.halving**2

    def inner(self, margin_px: tuple[int, int, int, int]) -> np.ndarray:
        """(height, width) bool: within left, top, right, bottom margins."""
        left, top, right, bottom = (side // self.halving for side in margin_px)
        height, width = self.splat.shape[0], self.splat.shape[1]
        inside = np.zeros((height, width), bool)
        inside[top : height - bottom, left : width - right] = True
        return inside

    def wanted(self, tier: int, bias: float = 0.0, where: np.ndarray | None = None) -> Feedback:
        """The page of each splat's level of detail floor(lod + bias); lod = log2(photo pixels a screen pixel), by areas
        of the disc, as shaders/baseline.vert.glsl has it."""
        p, layout = self.places, self.places.layout
        pixels, nearest = np.zeros(layout.n_pages), np.full(layout.n_pages, np.inf)
        everywhere = np.ones(self.splat.shape, bool) if where is None else where
        eye = np.asarray(self.pose.centre, np.float64)
        _collect(
            self.splat, everywhere, p.centre, p.normal, p.octaves, p.photo, p.x, p.y, eye, self.pose.rotation[2],
            self.screen.focal_px, bias, layout.grids, layout.texels_a_page, layout.first_grid, layout.levels, pixels, nearest,
        )  # fmt: skip
        pages = np.flatnonzero(pixels)
        return Feedback(
            pages,
            np.full(len(pages), tier, np.int8),
            pixels[pages] * float(self.halving**2),
            np.clip(nearest[pages] * FAR, 0, FAR).astype(np.uint8),
        )


def octaves_of(ray: np.ndarray, depth: np.ndarray, normal: np.ndarray, focal_px: float) -> np.ndarray:
    """log2 of pixels a unit of length on discs (n,): half that of their area's, f^2 |ray . normal| / depth^3."""
    depth = np.maximum(depth, 1e-9)
    cosine = np.maximum(np.abs((ray * normal).sum(axis=1)) / depth, LEAST_COSINE)
    return np.log2(focal_px / depth) + 0.5 * np.log2(cosine)


def places_of(
    centre: np.ndarray,  # (n, 3) absolute
    radius: np.ndarray,  # (n,)
    normal: np.ndarray,  # (n, 3)
    camera: np.ndarray,  # (n,) of `cameras`, NO_CAMERA where a splat has none
    cameras: tuple[Camera, ...],
    magnified: int = 1,
    page_px: int = 128,
) -> Places:
    """The places of splats in photographs that are `magnified` times as wide as `cameras` say."""
    textured = camera != NO_CAMERA
    centre, radius, normal = centre[textured], radius[textured], normal[textured]
    photo = camera[textured].astype(np.int64)
    x, y, octaves = (np.zeros(len(centre)) for _ in range(3))
    for i, c in enumerate(cameras):
        rows = photo == i
        ray = centre[rows] - np.array(c.centre)
        local = ray @ np.array(c.rotation).T
        depth = np.maximum(local[:, 2], 1e-9)
        x[rows] = magnified * (c.fx_px * local[:, 0] / depth + c.cx_px)
        y[rows] = magnified * (c.fy_px * local[:, 1] / depth + c.cy_px)
        octaves[rows] = octaves_of(ray, depth, normal[rows], magnified * (c.fx_px * c.fy_px) ** 0.5)
    sizes = tuple((magnified * c.width_px, magnified * c.height_px) for c in cameras)
    return Places(centre, radius, normal, photo, x, y, octaves, PageLayout(sizes, page_px))


@kernel()
def draw_squares(centre, radius, rotation, eye, scale, middle_x, middle_y, nearest, shown):
    """A square as wide as each splat, the nearest wins; equally near ones by number."""
    height, width = shown.shape
    for i in range(len(centre)):
        dx, dy, dz = centre[i, 0] - eye[0], centre[i, 1] - eye[1], centre[i, 2] - eye[2]
        z = rotation[2, 0] * dx + rotation[2, 1] * dy + rotation[2, 2] * dz
        if z <= NEAR * radius[i]:
            continue
        x = scale * (rotation[0, 0] * dx + rotation[0, 1] * dy + rotation[0, 2] * dz) / z + middle_x
        y = scale * (rotation[1, 0] * dx + rotation[1, 1] * dy + rotation[1, 2] * dz) / z + middle_y
        half = min(max(scale * radius[i] / z, 0.5), MOST_SQUARE_PX)
        if x + half < 0 or y + half < 0 or x - half >= width or y - half >= height:
            continue
        for row in range(max(0, int(np.floor(y - half + 0.5))), min(height, int(np.floor(y + half + 0.5)))):
            for column in range(max(0, int(np.floor(x - half + 0.5))), min(width, int(np.floor(x + half + 0.5)))):
                if np.float32(z) < nearest[row, column]:
                    nearest[row, column] = np.float32(z)
                    shown[row, column] = i


@kernel()
def _collect(
    shown, where, centre, normal, octaves, photo, x, y, eye, ahead, focal, bias, grids, texels, first_grid, n_levels,
    pixels, nearest,
):  # fmt: skip
    """Pixels of each page, and how near to the middle the nearest of them is, 1 at the corners."""
    height, width = shown.shape
    longest = (width / 2) ** 2 + (height / 2) ** 2
    count, near = np.zeros(len(centre), np.int32), np.full(len(centre), np.inf)
    touched = np.empty(len(centre), np.int32)
    n_touched = 0
    for row in range(height):
        for column in range(width):
            i = shown[row, column]
            if i >= 0 and where[row, column]:
                if count[i] == 0:
                    touched[n_touched] = i
                    n_touched += 1
                count[i] += 1
                near[i] = min(near[i], (column - width / 2) ** 2 + (row - height / 2) ** 2)
    for at in range(n_touched):
        i = touched[at]
        dx, dy, dz = centre[i, 0] - eye[0], centre[i, 1] - eye[1], centre[i, 2] - eye[2]
        depth = max(dx * ahead[0] + dy * ahead[1] + dz * ahead[2], 1e-9)
        cosine = abs(dx * normal[i, 0] + dy * normal[i, 1] + dz * normal[i, 2]) / depth
        level = octaves[i] - np.log2(focal / depth) - 0.5 * np.log2(max(cosine, LEAST_COSINE)) + bias
        coarsest = n_levels[photo[i]] - 1
        grid = first_grid[photo[i]] + min(max(int(np.floor(level)), 0), coarsest)
        c = min(max(int(np.floor(x[i] / texels[grid, 0])), 0), grids[grid, 3] - 1)
        r = min(max(int(np.floor(y[i] / texels[grid, 1])), 0), grids[grid, 4] - 1)
        page = grids[grid, 2] + r * grids[grid, 3] + c
        pixels[page] += count[i]
        nearest[page] = min(nearest[page], np.sqrt(near[i] / longest))
