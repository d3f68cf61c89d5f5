"""A view as the shaders take it: a pinhole camera (storage.packed.schema.Camera) and the scene's near plane and
margin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from storage.errors import InvalidScan
from storage.packed.schema import Camera, Header

NEAR_IN_RADII = 0.01  # depth is floating point and reversed, so this costs no precision far away


def view_block(view: Camera, header: Header) -> bytes:
    """The uniform block `View` of shaders/view.glsl."""
    rows = np.zeros((8, 4), np.float32)
    rows[:3, :3] = view.rotation
    rows[3, :3], rows[4, :3] = split_floats(eye_against_origin(view, header))
    rows[5] = view.fx_px, view.fy_px, view.cx_px, view.cy_px
    rows[6] = view.width_px, view.height_px, NEAR_IN_RADII * header.radius, header.margin_radii
    return rows.tobytes()[: 7 * 16]


def larger(view: Camera, times: int) -> Camera:
    """The same view, of `times` as many pixels to a side."""
    if times == 1:
        return view
    pixels = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px")
    return replace(view, **{name: times * getattr(view, name) for name in pixels})


def eye_against_origin(view: Camera, header: Header) -> np.ndarray:
    """The camera's centre (3,) float64 against the packed file's origin."""
    return np.subtract(view.centre, header.origin, dtype=np.float64)  # (3,)


def split_floats(value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two float32 arrays whose exact sum is `value` to 48 bits."""
    high = value.astype(np.float32)
    return high, (value - high).astype(np.float32)


def view_to_photo(view: Camera, photo: Camera) -> np.ndarray:
    """(4, 4) float64 from a point in the view's axes (x, y, z, 1) to homogeneous px of the photo in its first three."""
    rotation = np.array(photo.rotation) @ np.array(view.rotation).T
    offset = np.array(photo.rotation) @ np.subtract(view.centre, photo.centre, dtype=np.float64)
    lens = np.array([[photo.fx_px, 0, photo.cx_px], [0, photo.fy_px, photo.cy_px], [0, 0, 1]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = lens @ rotation, lens @ offset
    return matrix


def checked_view(view: Camera) -> Camera:
    """The view itself, or InvalidScan where no picture can be made of it."""
    numbers = [view.fx_px, view.fy_px, view.cx_px, view.cy_px, *np.ravel(view.rotation), *view.centre]
    if not np.isfinite(numbers).all():
        raise InvalidScan(f"camera {view.name!r}", f"numbers {numbers}", "finite numbers")
    if view.fx_px <= 0 or view.fy_px <= 0 or view.width_px < 1 or view.height_px < 1:
        found = f"{view.width_px}x{view.height_px} px, focal lengths {view.fx_px} and {view.fy_px} px"
        raise InvalidScan(f"camera {view.name!r}", found, "sizes of 1 px or more and focal lengths above 0")
    return view
