"""Disc or ellipsoid: right on ropes, balls and flat things with edges, as a scanner sees them."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pipeline.effects.ellipsoids.arcs import RING_RADII, _longest_run, reach_arc
from pipeline.effects.ellipsoids.decision import CELLS_RADII, REACH_RADII, thin_splats
from pipeline.effects.ellipsoids.fit import LEAST_RADII, fit, moments, principal_axes
from pipeline.effects.ellipsoids.full import is_full
from pipeline.effects.ellipsoids.hypotheses import HYPOTHESES, three_members
from pipeline.effects.ellipsoids.nearest import gather
from pipeline.effects.ellipsoids.neighbourhoods import LEAST, MOST, Around
from pipeline.effects.ellipsoids.noise import histogram_of, noise_radii, thirds_of
from pipeline.effects.ellipsoids.spread import spread_of
from pipeline.effects.ellipsoids.thinned import thinned
from tests.thin_scene import BALL, FLAT, ROPE, THICK, THIN, joined, room, scan

SCANNERS = ((2.6, -1.6, 1.6), (-2.4, -2.0, 1.2))


def verdicts(position, radius=None):
    """Which points become ellipsoids, and the noise that was found, in radii."""
    radius = radius or np.median(cKDTree(position).query(position, k=5)[0][:, 4])
    around = Around(thinned(position, 0.5 * radius), CELLS_RADII * radius)
    noise = noise_radii(histogram_of(thirds_of(gather(position, around, REACH_RADII * radius)) / radius))
    return thin_splats(position, around, radius, noise * radius), noise


def grid(n, spacing=1.0, jitter=0.2, seed=0):
    """Points (n^2, 3) of a square in z = 0, its middle at 0."""
    rng = np.random.default_rng(seed)
    x, y = (a.ravel() * spacing for a in np.meshgrid(np.arange(n) - (n - 1) / 2, np.arange(n) - (n - 1) / 2))
    flat = np.column_stack([x, y, np.zeros(n * n)])
    return flat + rng.normal(0, jitter * spacing, flat.shape) * [1, 1, 0]


@pytest.mark.parametrize("seed, step, noise", [(11, 0.0035, 0.0020), (13, 0.0040, 0.0010)])
def test_decide__is_right_on_19_of_20_points_of_a_room_of_ropes_balls_and_flat_things(seed, step, noise):
    rng = np.random.default_rng(seed)
    shapes = room(rng)
    seen = joined([scan(shapes, eye, step, noise, rng) for eye in SCANNERS])
    thin, _ = verdicts(seen.position)
    right = thin == np.isin(seen.kind, THIN)
    shares = {kind: right[seen.kind == kind].mean() for kind in (FLAT, THICK, ROPE, BALL)}
    assert right.mean() >= 0.95
    assert shares[FLAT] >= 0.99 and shares[BALL] >= 0.95
    assert shares[ROPE] >= 0.95
    assert np.mean([shares[FLAT], shares[ROPE], shares[BALL]]) >= 0.95


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.3])
def test_decide__a_plane_is_discs_to_its_corners(noise):
    position = grid(60) + np.random.default_rng(1).normal(0, noise, (3600, 3)) * [0, 0, 1]
    thin, found = verdicts(position)
    assert thin.mean() <= 0.01
    assert 0.6 * noise <= found <= 1.2 * noise + 0.01


@pytest.mark.parametrize("degrees", [60, 90, 140])
def test_decide__a_crease_is_discs(degrees):
    half = grid(50)
    half = half[half[:, 0] > 0]
    turned = half @ np.array([[np.cos(a := np.radians(degrees)), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    thin, _ = verdicts(np.concatenate([half, turned]))
    assert thin.mean() <= 0.02


@pytest.mark.parametrize("thickness", [0.6, 1.5, 3.0])
def test_decide__both_faces_of_a_board_are_discs(thickness):
    thin, _ = verdicts(np.concatenate([grid(40), grid(40, seed=5) + [0, 0, thickness]]), radius=1.25)
    assert thin.mean() <= 0.01


def test_decide__a_corner_of_a_box_is_discs():
    quarter = grid(40)
    quarter = quarter[(quarter[:, :2] > 0).all(axis=1)]
    thin, _ = verdicts(np.concatenate([np.roll(quarter, k, axis=1) for k in range(3)]))
    assert thin.mean() <= 0.05


@pytest.mark.parametrize("apart", [3.0, 5.0])
def test_decide__scan_lines_far_apart_are_discs_and_a_lone_pair_of_wires_is_not(apart):
    rng = np.random.default_rng(9)
    lines = grid(60, spacing=0.5, jitter=0) * [1, 2 * apart, 1] + rng.normal(0, 0.05, (3600, 3))
    inside = (np.abs(lines[:, 1]) < 25 * apart) & (np.abs(lines[:, 0]) < 8)  # where they end, they end like wires
    assert verdicts(lines, radius=1.0)[0][inside].mean() <= 0.08
    pair = lines[np.abs(lines[:, 1]) < apart]
    assert verdicts(pair, radius=1.0)[0].mean() >= 0.9


@pytest.mark.parametrize("radius", [0.1, 0.5])
def test_decide__a_wire_before_a_wall_is_ellipsoids(radius):
    rng = np.random.default_rng(2)
    angle, along = rng.uniform(0, 2 * np.pi, 120), rng.uniform(-25, 25, 120)
    wire = np.column_stack([along, radius * np.cos(angle), radius * np.sin(angle) + 6])
    thin, _ = verdicts(np.concatenate([grid(60), wire]))
    assert thin[3600:].mean() >= 0.95 and thin[:3600].mean() <= 0.01


@pytest.mark.parametrize("degrees", [35, 60, 90])
def test_decide__two_wires_that_cross_are_ellipsoids(degrees):
    rng = np.random.default_rng(10)
    angle, along = rng.uniform(0, 2 * np.pi, (2, 160)), rng.uniform(-25, 25, (2, 160))
    one, other = np.stack([along, 0.3 * np.cos(angle), 0.3 * np.sin(angle)], axis=2)
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    other = other @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [0, 0, 0.5]
    thin, _ = verdicts(np.concatenate([grid(60) - [0, 0, 20], one, other]), radius=1.0)
    at_crossing = np.linalg.norm(np.concatenate([one, other]), axis=1) <= REACH_RADII
    assert at_crossing.sum() >= 10
    assert thin[3600:][at_crossing].mean() >= 0.9 and thin[:3600].mean() <= 0.01


def test_decide__turning_scaling_and_moving_a_scan_changes_next_to_nothing():
    rng = np.random.default_rng(3)
    shapes = room(rng)
    position = scan(shapes, SCANNERS[0], 0.005, 0.002, rng).position
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    here, _ = verdicts(position)
    there, _ = verdicts(3.0 * position @ turn + [100, 200, -50])
    assert (here != there).mean() <= 0.02  # cells of the thinning fall elsewhere


def test_decide__points_without_neighbours_and_equal_points_are_discs():
    apart = np.arange(12.0)[:, None] * [1000.0, 0, 0]
    assert not verdicts(apart, radius=1.0)[0].any()
    assert not thin_splats(np.zeros((5, 3)), Around(np.zeros((1, 3)), 0.5), 1.0, 0.0).any()
    assert not thin_splats(np.zeros((5, 3)), Around(np.zeros((0, 3)), 0.5), 1.0, 0.0).any()
    assert thin_splats(np.zeros((0, 3)), Around(np.zeros((0, 3)), 0.5), 1.0, 0.0).shape == (0,)


# --- neighbourhoods, section 3.1 ------------------------------------------------------------------------------------


def test_gather__takes_all_within_reach_or_the_nearest_without_outliers_or_none():
    many = np.column_stack([np.linspace(0, 1, 9), np.zeros(9), np.zeros(9)])
    assert gather(np.zeros((1, 3)), Around(many, 0.5), 1.0).count.tolist() == [9]
    few = np.array([[0, 0, 0], [0.5, 0, 0], [2.0, 0, 0], [2.5, 0, 0], [2.9, 0, 0], [3.5, 0, 0], [9, 0, 0]])
    assert gather(np.zeros((1, 3)), Around(few, 0.5), 1.0).count.tolist() == [5]
    assert gather(np.zeros((1, 3)), Around(few, 0.6), 1.2).count.tolist() == [LEAST]
    assert gather(np.zeros((1, 3)), Around(few[[0, 1, 5, 6]], 0.5), 1.0).count.tolist() == [0]


def test_gather__agrees_with_brute_force():
    rng = np.random.default_rng(4)
    points = rng.normal(size=(300, 3))
    found = gather(points, Around(points, 0.3), 0.6)
    distance = np.linalg.norm(points[:, None] - points, axis=2)
    for i in range(300):
        near = np.sort(distance[i][distance[i] <= 0.6])
        wanted = near if len(near) >= LEAST else np.sort(distance[i])[:LEAST][np.sort(distance[i])[:LEAST] <= 1.8]
        wanted = wanted[:MOST] if len(wanted) >= 3 else wanted[:0]
        np.testing.assert_allclose(np.linalg.norm(found.offset[i, : found.count[i]], axis=1), wanted, atol=1e-12)
        assert not found.offset[i, found.count[i] :].any() or found.count[i] < LEAST or (near <= 0.6).all()


@pytest.mark.parametrize("edge", [0.3, 0.1, 0.05])
def test_gather__takes_the_nearest_of_many_whatever_the_cells_and_puts_back_what_thinning_took(edge):
    rng = np.random.default_rng(6)
    points, apart = np.unique(rng.integers(-9, 10, (3000, 3)) / 50, axis=0), np.array([[0.011, 0.003, 0.007]])
    found = gather(np.concatenate([points[::40], apart]), Around(points, edge), 0.3)
    whole = gather(np.concatenate([points[::40], apart]), Around(points, 0.15), 0.3)
    assert (found.offset == whole.offset).all() and (found.count == MOST).all()
    away = np.linalg.norm(found.offset, axis=2)
    for i, point in enumerate(np.concatenate([points[::40], apart])):
        wanted = np.sort(np.append(np.linalg.norm(points - point, axis=1), [0.0] * (i == len(away) - 1)))[:MOST]
        np.testing.assert_allclose(away[i], wanted, atol=1e-12)


def _longest_arc(offset: np.ndarray, tolerance: float) -> float:
    """By all planes and lines of `reach_arc`, each from nothing."""
    best = 0.0
    for h in range(HYPOTHESES):
        a, b, c = (offset[m] for m in three_members(h, len(offset)))
        normal = np.cross(b - a, c - a)
        if np.linalg.norm(normal) <= 0.2 * np.linalg.norm(b - a) * np.linalg.norm(c - a):
            continue
        normal /= np.linalg.norm(normal)
        u = (b - a) / np.linalg.norm(b - a)
        x, y = offset @ u, offset @ np.cross(normal, u)
        for height in ((offset - a) @ normal, -(offset - a) @ normal):
            if abs(height[0]) > tolerance:
                continue
            for angle in 2 * np.pi * np.arange(16) / 16:
                along = np.cos(angle) * x + np.sin(angle) * y
                cut = along[height > tolerance].max(initial=-np.inf)
                kept = (abs(height) <= tolerance) & (np.hypot(x, y) >= RING_RADII) & (along >= cut)
                if cut < 0 and kept.any():
                    order = np.argsort(np.arctan2(y[kept], x[kept]))
                    best = max(best, _longest_run(x[kept][order], y[kept][order], len(order)))
    return best


def test_reach_arc__agrees_with_every_plane_and_line_tried():
    rng = np.random.default_rng(3)
    offset, count = np.zeros((60, MOST, 3)), np.full(60, 40)
    for i in range(60):
        flat, turned = np.array([1, 1, rng.choice([0.05, 0.3, 1])]), np.linalg.qr(rng.normal(size=(3, 3)))[0]
        offset[i, 1:40] = (rng.normal(size=(39, 3)) * flat * rng.uniform(0.5, 1.5)) @ turned
        offset[i, 1:40][rng.random(39) < rng.choice([0, 0.5])] *= rng.choice([1, -1])
    arcs = np.array([_longest_arc(o[:40], 0.3) for o in offset])
    for enough in np.radians([60, 110, 200, 270]):
        found = reach_arc(offset, count, 0.3, enough)
        assert (found == (arcs >= enough)).all() and 0 < found.sum() < 60


def test_thinned__leaves_one_point_a_cell_whatever_the_order():
    rng = np.random.default_rng(5)
    points = rng.uniform(-3, 3, (2000, 3))
    kept = thinned(points, 0.7)
    cells = np.floor(kept / 0.7).astype(int)
    assert len(np.unique(cells, axis=0)) == len(kept) == len(np.unique(np.floor(points / 0.7).astype(int), axis=0))
    assert (thinned(points[rng.permutation(2000)], 0.7) == kept).all()


@pytest.mark.parametrize("away", [0.0, 1e6])
def test_spread__is_that_of_all_members_whatever_their_company(away):
    rng = np.random.default_rng(12)
    points = rng.normal(size=(900, 3)) * [1, 1, 0.2] + away
    around = Around(points[::2], 0.25)
    found = spread_of(points, around, 0.5, 0.2)
    for i, point in enumerate(points):
        distance = np.linalg.norm(points[::2] - point, axis=1)
        near = points[::2][distance <= 0.5]
        near = near if i % 2 == 0 else np.concatenate([near, point[None]])
        if len(near) > 1 and np.abs(distance - 0.5).min() > 2 / 640:  # none on the rim
            assert found.count[i] == len(near)
            deviation = principal_axes(np.cov(near.T)[None])[0][0]
            assert found.is_wide[i] == (deviation[1] > 0.2) or deviation[1] == pytest.approx(0.2, abs=2e-3)
            np.testing.assert_allclose(found.deviation[i], deviation * ~found.is_wide[i], atol=2e-3)
    some = rng.permutation(900)[:100]
    again = spread_of(points[some], around, 0.5, 0.2)
    assert (again.count == found.count[some]).all() and 0 < found.is_wide.sum() < 900


def test_is_full__where_most_or_more_lie_within_the_reach():
    points = np.random.default_rng(13).normal(size=(900, 3))
    full = is_full(points, Around(points, 0.25), 0.8)
    within = (np.linalg.norm(points[:, None] - points, axis=2) <= 0.8).sum(axis=1)
    assert (full == (within >= MOST)).all() and 0 < full.sum() < 900


# --- fit --------------------------------------------------------------------------------------------------------------


def test_moments__are_those_of_numpy():
    rng = np.random.default_rng(6)
    offset, count = rng.normal(size=(40, 12, 3)), rng.integers(2, 13, 40)
    mean, covariance = moments(offset, count)
    for i in range(40):
        np.testing.assert_allclose(mean[i], offset[i, : count[i]].mean(axis=0), atol=1e-12)
        np.testing.assert_allclose(covariance[i], np.cov(offset[i, : count[i]].T), atol=1e-12)
    deviation, axes = principal_axes(covariance)
    np.testing.assert_allclose(np.einsum("nai,na,naj->nij", axes, deviation**2, axes), covariance, atol=1e-12)
    assert (np.diff(deviation, axis=1) <= 0).all() and (np.linalg.det(axes) > 0).all()


def wire(n, radius, length, seed=7):
    rng = np.random.default_rng(seed)
    angle, along = rng.uniform(0, 2 * np.pi, n), np.linspace(-length / 2, length / 2, n)
    return np.column_stack([along, radius * np.cos(angle), radius * np.sin(angle)])


def test_fit__is_as_thick_as_the_wire_and_lies_along_it():
    points = wire(400, 0.5, 60)
    offset, axes = fit(points[100:300], points, 1.0)
    length = np.linalg.norm(axes, axis=2)
    assert np.abs((points[100:300] + offset)[:, 1:]).max() <= 0.35
    assert np.median(length[:, 1:]) == pytest.approx(0.6, abs=0.2) and length[:, 1:].max() <= 1.0
    assert (np.abs(axes[:, 0, 0]) / length[:, 0]).min() >= 0.9 and length[:, 0].min() >= 1.0


def test_fit__bridges_gaps_along_a_wire_but_not_between_scattered_points():
    sparse = wire(30, 0.05, 58)  # two radii apart, so alone within the reach
    _, axes = fit(sparse, sparse, 1.0)
    assert np.linalg.norm(axes[5:-5, 0], axis=1).min() >= 1.5
    rng = np.random.default_rng(8)
    scattered = rng.uniform(-10, 10, (400, 3))  # 2.7 radii apart
    offset, axes = fit(scattered, scattered, 1.0)
    fat = np.linalg.norm(axes, axis=2)[:, 1] > 0.6
    assert fat.mean() <= 0.1 and np.linalg.norm(offset, axis=1).mean() <= 0.6


def test_fit__a_point_alone_is_a_small_ball_where_it_is():
    offset, axes = fit(np.zeros((1, 3)), np.zeros((1, 3)), 1.0)
    assert not offset.any() and np.linalg.norm(axes, axis=2).tolist() == [[LEAST_RADII] * 3]
