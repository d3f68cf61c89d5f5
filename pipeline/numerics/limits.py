"""How large and how small a scan may be, so that no square of a length overflows or vanishes in float32 on a GPU."""

from __future__ import annotations

import numpy as np

from storage.errors import InvalidScan

LARGEST_COORDINATE = 1e15  # its square is 1e30, 1e8 below the largest float32
SMALLEST_RADIUS = 1e-12  # its square is 1e-24, 1e14 above the smallest float32 of full precision


def check_bounds(where: str, low: np.ndarray, high: np.ndarray) -> None:
    """Raises InvalidScan where a corner of the scan's bounds, (3,) each, lies further out than is handled."""
    furthest = max(np.abs(low).max(), np.abs(high).max())
    if not furthest <= LARGEST_COORDINATE:
        raise InvalidScan(
            where,
            f"a coordinate of {furthest:g}",
            f"-{LARGEST_COORDINATE:g} to {LARGEST_COORDINATE:g}",
            "such values are most often damage, or a mark for missing points; drop those points",
        )


def check_radius(where: str, radius: float) -> None:
    """Raises InvalidScan for a splat radius that squares cannot hold."""
    if not SMALLEST_RADIUS <= radius <= LARGEST_COORDINATE:
        raise InvalidScan(
            where,
            f"a splat radius of {radius:g}",
            f"{SMALLEST_RADIUS:g} to {LARGEST_COORDINATE:g}",
            "scale the scan, or give one with --radius",
        )
