"""Outlines from new viewpoints: ellipsoids come closer to what is there than discs do (paper 2020, Figure 6)."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pipeline.effects.ellipsoids.decision import CELLS_RADII, REACH_RADII, thin_splats
from pipeline.effects.ellipsoids.fit import fit
from pipeline.effects.ellipsoids.nearest import gather
from pipeline.effects.ellipsoids.neighbourhoods import Around
from pipeline.effects.ellipsoids.noise import histogram_of, noise_radii, thirds_of
from pipeline.effects.ellipsoids.thinned import thinned
from pipeline.splats.normals import NEIGHBOURS, estimate_normals
from tests.renderer.splats.test_renderer import drawn
from tests.scenes import Settings, Splats, build_scene, camera_looking
from tests.thin_scene import THIN, Shapes, joined, room, scan, silhouette

SCANNERS = ((2.6, -1.6, 1.6), (-2.4, -2.0, 1.2))
VIEWPOINTS = ((1.6, 1.2, 1.2), (-1.8, 0.9, 0.5), (0.2, 2.0, 0.9), (0.3, -1.2, 2.2))  # none near a scanner's


def thin_part(shapes):
    thin = np.isin(shapes.kind, THIN)
    return Shapes(
        np.zeros((0, 3)),
        np.zeros((0, 2, 3)),
        shapes.start[thin],
        shapes.end[thin],
        shapes.radius[thin],
        shapes.kind[thin],
    )


def overlap(found, truth):
    return (found & truth).sum() / (found | truth).sum()


def splats_of_thin_things(seen):
    """Discs of the points on ropes and balls; the same with ellipsoids where the decision says so; and the radius."""
    radius = np.median(cKDTree(seen.position).query(seen.position, k=5)[0][:, 4])
    around = Around(thinned(seen.position, 0.5 * radius), CELLS_RADII * radius)
    noise = radius * noise_radii(histogram_of(thirds_of(gather(seen.position, around, REACH_RADII * radius)) / radius))
    point = seen.position[np.isin(seen.kind, THIN)]
    index = cKDTree(seen.position).query(point, k=NEIGHBOURS + 1)[1][:, 1:]
    normal, _ = estimate_normals(point, seen.position[index])
    thin = thin_splats(point, around, radius, noise)
    offset, half_axes = fit(point[thin], np.unique(seen.position, axis=0), radius)
    moved, turned, axes = point.copy(), normal.copy(), np.full((len(point), 3, 3), np.nan)
    moved[thin] += offset
    axes[thin], turned[thin] = half_axes, half_axes[:, 2] / np.linalg.norm(half_axes[:, 2], axis=1, keepdims=True)
    return Splats(point, normal), Splats(moved, turned, axes=axes), radius


def outlines(renderer, splats, radius, views):
    scene = build_scene(splats, Settings(radius=radius, depth_margin=radius))
    return [drawn(renderer, scene, view).coverage for view in views]


@pytest.mark.parametrize("seed, step, noise", [(1, 0.0035, 0.0015), (4, 0.0030, 0.0025)])
def test_silhouettes__of_ellipsoids_overlap_the_true_ones_more_than_those_of_discs_from_everywhere(
    renderer, seed, step, noise
):
    rng = np.random.default_rng(seed)
    shapes = room(rng)
    discs, ellipsoids, radius = splats_of_thin_things(joined([scan(shapes, eye, step, noise, rng) for eye in SCANNERS]))
    views = [camera_looking(eye, (0, 0, 0.6), (400, 300), (350, 350)) for eye in VIEWPOINTS]
    truth = [silhouette(thin_part(shapes), view) > 0 for view in views]
    of_discs, of_ellipsoids = (
        np.array([overlap(*pair) for pair in zip(outlines(renderer, splats, radius, views), truth, strict=True)])
        for splats in (discs, ellipsoids)
    )
    assert (of_ellipsoids >= of_discs + 0.05).all()
    assert of_ellipsoids.mean() >= 0.6 and of_ellipsoids.mean() >= of_discs.mean() + 0.1


def test_silhouettes__points_held_out_lie_more_densely_in_those_of_ellipsoids(renderer):
    """Without knowing the truth: half of the points make the splats, the other half say what should be covered."""
    rng = np.random.default_rng(5)
    seen = joined([scan(room(rng), eye, 0.003, 0.001, rng) for eye in SCANNERS])
    held = rng.random(len(seen.position)) < 0.5
    kept = type(seen)(seen.position[~held], seen.kind[~held], seen.scanner[~held])
    discs, ellipsoids, radius = splats_of_thin_things(kept)
    point = seen.position[held & np.isin(seen.kind, THIN)]
    for eye in VIEWPOINTS:
        view = camera_looking(eye, (0, 0, 0.6), (400, 300), (350, 350))
        at = (point - view.centre) @ np.array(view.rotation).T
        column, row = (350 * at[:, :2] / at[:, 2:] + [view.cx_px, view.cy_px]).T
        inside = (column >= 0) & (column < 400) & (row >= 0) & (row < 300)
        pixel = row[inside].astype(int), column[inside].astype(int)
        (of_discs,), (of_ellipsoids,) = (outlines(renderer, splats, radius, [view]) for splats in (discs, ellipsoids))
        assert of_ellipsoids[pixel].mean() >= 0.6
        assert of_ellipsoids[pixel].sum() / of_ellipsoids.sum() >= 1.15 * of_discs[pixel].sum() / of_discs.sum()
