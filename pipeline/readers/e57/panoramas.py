"""Spherical and cylindrical images of an E57 file as pinhole photographs: parts of the horizon, and two caps.

In the image's frame azimuth 0 (along x) and elevation 0 lie in the middle of a spherical image, azimuth grows to the left,
towards y, and elevation upwards, towards z; rows of a cylinder are tangents of elevation, from `principalPointY` on:

    column = width / 2 - azimuth / pixelWidth
    row    = height / 2 - elevation / pixelHeight                               (sphere)
    row    = principalPointY - tan(elevation) radius / pixelHeight              (cylinder)

A part is as fine as the image is at its horizon, and shows nothing that the image does not.

References: ASTM E2807-11, section 8.4.4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from pipeline.execution.compiled import kernel

STEEPEST = math.radians(60)  # elevation that a part of the horizon shows, where no cap goes on from 45 degrees
LEAST_SPAN = 0.1  # radians: an image that spans less is of pixels whose size is in another unit
ROUNDING = 1e-3
WIDEST = math.pi / 2  # of a part of the horizon between two caps: six sides of a cube show everything
NARROW = (
    math.pi / 4
)  # elsewhere: at its sides a part shows elevations up to 0.92 of those in its middle, by their tangent
_DOWN = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True)
class Panorama:
    """Where an image of width_px x height_px shows which direction."""

    width_px: int
    height_px: int
    pixel_width: float  # radians
    horizon_px: float  # the row of elevation 0
    pixel_height: float  # radians of a sphere; of a cylinder the tangent of elevation
    is_sphere: bool = True

    @property
    def span(self) -> float:
        return self.width_px * self.pixel_width

    @property
    def is_whole_turn(self) -> bool:
        return self.span >= 2 * math.pi - self.pixel_width

    def steepest(self, rows: float) -> float:
        """The elevation, in radians, that lies so many rows off the horizon."""
        return min(math.pi / 2, rows * self.pixel_height) if self.is_sphere else math.atan(rows * self.pixel_height)


@dataclass(frozen=True)
class Part:
    """A pinhole photograph of a part of a panorama: `rotation` has its right, down and ahead in the image's frame as rows."""

    rotation: tuple[tuple[float, float, float], ...]
    width_px: int
    height_px: int
    focal_px: float
    cx_px: float
    cy_px: float


def whole_sphere(panorama: Panorama) -> Panorama | None:
    """The same image as of the whole sphere, where the angles of its pixels cannot be and it is twice as wide as high; None
    where they can, or it is not."""
    possible = LEAST_SPAN <= panorama.span <= 2 * math.pi * (1 + ROUNDING)
    possible &= not panorama.is_sphere or panorama.height_px * panorama.pixel_height <= math.pi * (1 + ROUNDING)
    if possible or not panorama.is_sphere or panorama.width_px != 2 * panorama.height_px:
        return None
    pixel = 2 * math.pi / panorama.width_px
    return replace(panorama, pixel_width=pixel, pixel_height=pixel)


def is_possible(panorama: Panorama) -> bool:
    """Whether its pixels span no more than there is."""
    tall = panorama.height_px * panorama.pixel_height if panorama.is_sphere else 0.0
    return panorama.span <= 2 * math.pi * (1 + ROUNDING) and tall <= math.pi * (1 + ROUNDING)


def share_left_out(panorama: Panorama) -> float:
    """The share of an image's pixels that no part shows: what is steeper than STEEPEST where no cap goes on, and corners."""
    span = min(panorama.span, 2 * math.pi)
    ends = elevations(panorama)
    caps = [_is_cap(panorama, e) for e in ends]
    n = _n_parts(span, caps)
    aside = np.cos((np.arange(64) + 0.5) / 64 * span / n / 2)  # of directions from a part's middle to its side
    shown = total = 0.0
    for e, cap in zip(ends, caps, strict=True):
        tangents = math.tan(min(e, STEEPEST)) * aside
        shown += e if cap else float(np.mean(np.arctan(tangents) if panorama.is_sphere else tangents))
        total += e if panorama.is_sphere else math.tan(e)
    return 1 - shown / total if total else 0.0


def _is_cap(panorama: Panorama, elevation: float) -> bool:
    """Whether an image goes on to the pole at this end, so that a cap shows what parts of the horizon do not."""
    return panorama.is_whole_turn and panorama.is_sphere and elevation >= math.pi / 2 - panorama.pixel_height


def _n_parts(span: float, caps: list[bool]) -> int:
    return max(1, math.ceil(span / (WIDEST if all(caps) else NARROW) - ROUNDING))


def parts_of(panorama: Panorama) -> tuple[Part, ...]:
    """The photographs that show a panorama; those of the horizon from the left on, then the caps."""
    span = min(panorama.span, 2 * math.pi)
    up, down = elevations(panorama)
    caps = [_is_cap(panorama, e) for e in (up, down)]
    n = _n_parts(span, caps)
    edge = math.tan(span / n / 2)
    width_px = max(1, math.floor(2 * edge / panorama.pixel_width))
    focal = width_px / (2 * edge)
    above, below = (
        focal * math.tan(math.pi / 4 if cap else min(e, STEEPEST)) for e, cap in zip((up, down), caps, strict=True)
    )
    parts = []
    for i in range(n):
        azimuth = span * ((n - 1) / 2 - i) / n
        ahead = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
        rotation = _rows(np.cross(_DOWN, ahead), _DOWN, ahead)
        parts.append(Part(rotation, width_px, max(1, math.floor(above + below)), focal, width_px / 2, above))
    side = max(1, math.floor(2 / panorama.pixel_width))
    right = np.array(parts[0].rotation[0])  # so that caps end where parts of the horizon do
    for is_cap, ahead in zip(caps, (-_DOWN, _DOWN), strict=True):
        if is_cap:
            parts.append(Part(_rows(right, np.cross(ahead, right), ahead), side, side, side / 2, side / 2, side / 2))
    return tuple(parts)


def elevations(panorama: Panorama) -> tuple[float, float]:
    """How far up and how far down a panorama shows, in radians; at least 0."""
    rows = panorama.horizon_px, panorama.height_px - panorama.horizon_px
    return tuple(max(0.0, panorama.steepest(r)) for r in rows)  # type: ignore[return-value]


def look_at(panorama: Panorama, part: Part, pixels: np.ndarray) -> np.ndarray:  # (height_px, width_px, 3) uint8
    """A part of a panorama of these pixels (h, w, 3), between whose centres colours are blended."""
    made = np.empty((part.height_px, part.width_px, 3), np.uint8)
    view = np.array([part.focal_px, part.cx_px, part.cy_px])
    scales = np.array([panorama.pixel_width, panorama.pixel_height, panorama.horizon_px])
    _look(
        np.ascontiguousarray(pixels),
        np.array(part.rotation),
        view,
        scales,
        panorama.is_sphere,
        panorama.is_whole_turn,
        made,
    )
    return made


def _rows(*rows: np.ndarray) -> tuple[tuple[float, float, float], ...]:
    return tuple(tuple(map(float, row)) for row in rows)  # type: ignore[misc]


@kernel()
def _look(pixels, rotation, view, scales, is_sphere, wraps, made):
    height, width, _ = pixels.shape
    for v in range(made.shape[0]):
        for u in range(made.shape[1]):
            a, b = (u + 0.5 - view[1]) / view[0], (v + 0.5 - view[2]) / view[0]
            x = a * rotation[0, 0] + b * rotation[1, 0] + rotation[2, 0]
            y = a * rotation[0, 1] + b * rotation[1, 1] + rotation[2, 1]
            z = a * rotation[0, 2] + b * rotation[1, 2] + rotation[2, 2]
            flat = math.hypot(x, y)
            rise = math.atan2(z, flat) if is_sphere else z / flat
            column = width / 2 - math.atan2(y, x) / scales[0] - 0.5
            row = min(max(scales[2] - rise / scales[1] - 0.5, 0.0), height - 1.0)
            if not wraps:
                column = min(max(column, 0.0), width - 1.0)
            left, top = int(math.floor(column)), min(int(row), max(height - 2, 0))
            s, t = column - left, row - top
            below, right = min(top + 1, height - 1), (left + 1) % width if wraps else min(left + 1, width - 1)
            left = left % width
            for c in range(3):
                upper = (1 - s) * pixels[top, left, c] + s * pixels[top, right, c]
                lower = (1 - s) * pixels[below, left, c] + s * pixels[below, right, c]
                made[v, u, c] = int((1 - t) * upper + t * lower + 0.5)
