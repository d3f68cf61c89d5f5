"""Which splats a view shows, and which page of its photograph each wants.

A small picture of splat numbers, drawn by a depth buffer of squares as wide as the splats: the places of pages,
not their colours. It stands for the feedback buffer of the renderer where paths are simulated, and for the second, small
rendering that pages are predicted by.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.execution.compiled import kernel
from renderer.residency.feedback import EMPTY, FAR, Feedback
from storage.packed.schema import NO_CAMERA, Camera
from storage.pages.layout import PageLayout

NEAR = 1e-3  # of a view's focal length in splat radii: nearer splats are behind the viewer, to us
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
    photo: np.ndarray  # (n,) int64; rows without a photograph are left out
    x: np.ndarray  # (n,) pixels of the finest level
    y: np.ndarray  # (n,)
    density: np.ndarray  # (n,) photo pixels a unit of length, across the line of sight
    layout: PageLayout

    def seen(self, pose: Pose, screen: Screen, halving: int, shift: tuple[float, float] = (0.0, 0.0)) -> Seen:
        """What a view shows. The picture is `halving` times smaller than the screen; its middle lies `shift` pixels
        beside the optical axis (a generalised frustum)."""
        scale = screen.focal_px / halving
        width, height = screen.width_px // halving, screen.height_px // halving
        middle = width / 2 - shift[0] / halving, height / 2 - shift[1] / halving
        shown = np.full((height, width), -1, np.int32)
        nearest = np.full((height, width), np.inf, np.float32)
        _draw(self.centre, self.radius, pose.rotation, pose.centre, scale, *middle, nearest, shown)
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
        """The page of each splat's level of detail floor(lod + bias), lod = log2(photo pixels a screen pixel)."""
        p = self.places
        count, near = np.zeros(len(p.centre), np.int32), np.full(len(p.centre), np.float32(np.inf))
        _collect(self.splat, np.ones(self.splat.shape, bool) if where is None else where, count, near)
        splats = np.flatnonzero(count)
        if not len(splats):
            return EMPTY
        depth = (p.centre[splats] - self.pose.centre) @ self.pose.rotation[2]
        lod = np.log2(p.density[splats] * depth / self.screen.focal_px)
        level = np.maximum(np.floor(lod + bias), 0).astype(np.int64)
        page = p.layout.pages_at(p.photo[splats], level, p.x[splats], p.y[splats])
        pages, row = np.unique(page, return_inverse=True)
        nearest = np.full(len(pages), np.float32(np.inf))
        np.minimum.at(nearest, row, near[splats])
        return Feedback(
            pages,
            np.full(len(pages), tier, np.int8),
            np.bincount(row, count[splats] * float(self.halving**2), len(pages)),
            np.clip(nearest * FAR, 0, FAR).astype(np.uint8),
        )


def places_of(
    centre: np.ndarray,  # (n, 3) absolute
    radius: np.ndarray,  # (n,)
    camera: np.ndarray,  # (n,) of `cameras`, NO_CAMERA where a splat has none
    cameras: tuple[Camera, ...],
    magnified: int = 1,
    page_px: int = 128,
) -> Places:
    """The places of splats in photographs that are `magnified` times as wide as `cameras` say."""
    textured = camera != NO_CAMERA
    centre, radius, photo = centre[textured], radius[textured], camera[textured].astype(np.int64)
    x, y, density = (np.zeros(len(centre)) for _ in range(3))
    for i, c in enumerate(cameras):
        rows = photo == i
        local = (centre[rows] - np.array(c.centre)) @ np.array(c.rotation).T
        depth = np.maximum(local[:, 2], 1e-9)
        x[rows] = magnified * (c.fx_px * local[:, 0] / depth + c.cx_px)
        y[rows] = magnified * (c.fy_px * local[:, 1] / depth + c.cy_px)
        density[rows] = magnified * (c.fx_px + c.fy_px) / 2 / depth
    sizes = tuple((magnified * c.width_px, magnified * c.height_px) for c in cameras)
    return Places(centre, radius, photo, x, y, density, PageLayout(sizes, page_px))


@kernel()
def _draw(centre, radius, rotation, eye, scale, middle_x, middle_y, nearest, shown):
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
def _collect(shown, where, count, near):
    """Pixels of each splat, and how near to the middle the nearest of them is, 1 at the corners."""
    height, width = shown.shape
    longest = np.hypot(width / 2, height / 2)
    for row in range(height):
        for column in range(width):
            i = shown[row, column]
            if i >= 0 and where[row, column]:
                count[i] += 1
                off = np.float32(np.hypot(column - width / 2, row - height / 2) / longest)
                near[i] = min(near[i], off)
