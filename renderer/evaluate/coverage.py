"""How well the discs of a packed file cover its surface: against discs as large as each splat's surroundings ask for,
exactly.

Drawn here, one disc after the other, in float64, with the low-pass filter of a pixel that the shaders have
(docs/FORMAT.md): a measure that does not rest on the renderer, and that needs no GPU. Splats that are ellipsoids are no
part of the surface, and cover it as discs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pipeline.execution.compiled import kernel
from pipeline.geometry.frame import tangent_frames
from pipeline.splats.decoded import scene_normal_codes, scene_positions, scene_radii
from pipeline.splats.sizes import needed_sizes
from renderer.splats.views import Direction, orbit_views
from storage.packed.packed import PackedScene
from storage.packed.schema import Camera

SIZE_PX = (960, 720)
OFF_RADII = 4.0  # what lies further from the surface than so many radii of its disc is another surface


@dataclass(frozen=True)
class ViewCoverage:
    """One view; all but `overdraw` are shares of the pixels of the surface."""

    camera: str
    surface_px: int
    holes: float  # nothing is drawn
    see_through: float  # what is drawn lies behind the surface
    before: float  # what is drawn lies before it
    overdraw: float  # discs drawn a pixel, against exact ones


def surface_coverage(
    scene: PackedScene, n_views: int = 3, size: tuple[int, int] = SIZE_PX, up: Direction | None = None
) -> list[ViewCoverage]:
    """The measure in `n_views` orbit views of a packed scene, of levels of its finest: splats of coarser ones lie on the same surface, and are
    not drawn with it."""
    header, finest = scene.header, slice(scene.header.first_finest, None)
    position, radius = scene_positions(scene)[finest], scene_radii(scene)[finest]
    spacing = cKDTree(np.unique(position, axis=0)).query(position, k=5)[0][:, 4]
    exact = needed_sizes(position, spacing, header.radius)
    is_ellipsoid = np.zeros(header.n_splats, bool)
    is_ellipsoid[scene.ellipsoids[0]] = True
    exact[is_ellipsoid[finest]] = 0.0
    u, v, _ = tangent_frames(scene_normal_codes(scene)[finest], header.up, header.ahead)
    return [
        _of_view(view, position + np.array(header.origin), u, v, exact, radius)
        for view in orbit_views(scene, n_views, size, up)
    ]


def _of_view(view: Camera, position, u, v, exact: np.ndarray, radius: np.ndarray) -> ViewCoverage:
    turn = np.array(view.rotation).T
    local = (position - view.centre) @ turn, u @ turn, v @ turn
    lens = np.array([view.fx_px, view.fy_px, view.cx_px, view.cy_px])
    surface, drawn = (np.full((view.height_px, view.width_px), np.inf) for _ in range(2))
    owner = np.full(surface.shape, -1)
    n_exact = draw_discs(*local, exact, lens, surface, owner)
    n_drawn = draw_discs(*local, np.where(exact > 0, radius, 0.0), lens, drawn, np.full(surface.shape, -1))
    draw_discs(*local, np.where(exact > 0, 0.0, radius), lens, drawn, np.full(surface.shape, -1))
    there = np.isfinite(surface)
    off = np.where(there, np.where(np.isfinite(drawn), drawn, 0) - np.where(there, surface, 0), 0)
    far = np.abs(off) > OFF_RADII * exact[owner]
    holes = there & ~np.isfinite(drawn)
    n = max(1, int(there.sum()))
    shares = (int(a.sum()) / n for a in (holes, there & ~holes & far & (off > 0), there & ~holes & far & (off < 0)))
    return ViewCoverage(view.name, int(there.sum()), *shares, n_drawn / max(1, n_exact))  # type: ignore[call-arg]


@kernel()
def draw_discs(centre, u, v, radius, lens, depth, owner):
    """Lower `depth` (height, width) to that of discs, in camera axes, and let `owner` have their numbers; returns how
    many pixels were drawn, one over the other. Discs nearer to the eye than two radii, and those without a radius, are
    left out."""
    height, width = depth.shape
    fx, fy, cx, cy = lens
    n_drawn = 0
    for i in range(centre.shape[0]):
        c, p, q, r = centre[i], u[i], v[i], radius[i]
        if r <= 0 or c[2] <= 2 * r:
            continue
        x, y = c[0] / c[2], c[1] / c[2]
        reach = r / (c[2] - r)
        a, b = fx * r * (p[0] - x * p[2]) / c[2], fx * r * (q[0] - x * q[2]) / c[2]
        d, e = fy * r * (p[1] - y * p[2]) / c[2], fy * r * (q[1] - y * q[2]) / c[2]
        total, det = a * a + b * b + d * d + e * e, a * e - b * d
        small = total - np.sqrt(max(0.0, total * total - 4 * det * det)) < 2.0
        n0, n1, n2 = p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]
        away = c[0] * n0 + c[1] * n1 + c[2] * n2
        px, py = fx * x + cx, fy * y + cy
        wide, tall = fx * reach * (1 + abs(x)) + 1, fy * reach * (1 + abs(y)) + 1
        for row in range(max(0, int(py - tall)), min(height, int(py + tall) + 1)):
            for column in range(max(0, int(px - wide)), min(width, int(px + wide) + 1)):
                if small:
                    s, t, z = column + 0.5 - px, row + 0.5 - py, c[2]
                    if s * s + t * t >= 1:
                        if abs(det) < 1e-12:
                            continue
                        s, t = (e * s - b * t) / det, (a * t - d * s) / det
                else:
                    ray_x, ray_y = (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy
                    z = away / (ray_x * n0 + ray_y * n1 + n2)
                    if not z > 0:
                        continue
                    o0, o1, o2 = ray_x * z - c[0], ray_y * z - c[1], z - c[2]
                    s, t = (o0 * p[0] + o1 * p[1] + o2 * p[2]) / r, (o0 * q[0] + o1 * q[1] + o2 * q[2]) / r
                if s * s + t * t < 1:
                    n_drawn += 1
                    if z < depth[row, column]:
                        depth[row, column] = z
                        owner[row, column] = i
    return n_drawn
