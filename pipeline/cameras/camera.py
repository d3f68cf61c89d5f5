"""What a camera is to all that looks at pictures: a way from points to pixels and back, and how much a pixel sees.

A photograph is a pinhole (`pinhole.py`), a laser station's map the whole sphere (`polar_capped.py`). Pixel (0.5, 0.5)
is the centre of the first pixel of both, columns first.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np


class Projection(Protocol):
    """A camera's projection, in float64. Points are absolute, in the scan's unit.

    Guarantees: `unproject(*project(p))` is `p`, wherever `project` gives a pixel.
    """

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the picture, px."""

    @property
    def centre(self) -> tuple[float, float, float]:
        """Where it stands."""

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (n, 2) of points (n, 3), and their depths (n,), as the camera measures depth; NaN for what it cannot
        see whatever its picture's size: a pinhole what lies behind it, both their own centre."""

    def unproject(self, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """The points (n, 3) at these pixels (n, 2) and depths (n,)."""

    def footprint(self, pixels: np.ndarray) -> np.ndarray:
        """The solid angle (n,) in steradians of a pixel around each of `pixels` (n, 2)."""
