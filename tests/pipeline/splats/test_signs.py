"""Signs of estimated normals: one side of each surface, whatever its shape."""

import numpy as np
import pytest

from pipeline.splats.signs import settled_signs


def torus(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and outward normals; those within the hole look towards the middle."""
    turn, around = 2 * np.pi * ((0.5 + np.arange(n) * np.array([[0.7548776662], [0.5698402910]])) % 1)
    ring = np.stack([np.cos(turn), np.sin(turn), np.zeros(n)], axis=1)
    normal = np.cos(around)[:, None] * ring + np.sin(around)[:, None] * [0.0, 0.0, 1.0]
    return 2 * ring + normal, normal


def thin_box(n: int, thickness: float = 0.2) -> tuple[np.ndarray, np.ndarray]:
    """Both sides of a sheet and its rim, bent: an ear."""
    side = np.random.default_rng(1).uniform(-1, 1, (n, 2))
    top = np.column_stack([side, 0.3 * side[:, 0] ** 2])
    slope = np.column_stack([-0.6 * side[:, 0], np.zeros(n), np.ones(n)])
    slope /= np.linalg.norm(slope, axis=1, keepdims=True)
    angle = np.linspace(-np.pi / 2, np.pi / 2, 24)
    along = np.linspace(-1, 1, 200)
    y, a = (x.ravel() for x in np.meshgrid(along, angle))
    rims = [
        (
            np.column_stack([s * (1 + thickness / 2 * np.cos(a)), y, 0.3 + thickness / 2 * np.sin(a)]),
            np.column_stack([s * np.cos(a), 0 * a, np.sin(a)]),
        )
        for s in (-1, 1)
    ]
    points = [top + thickness / 2 * slope, top - thickness / 2 * slope, *(p for p, _ in rims)]
    return np.concatenate(points), np.concatenate([slope, -slope, *(m for _, m in rims)])


@pytest.mark.parametrize("surface", [torus, thin_box])
def test_signs__are_those_of_one_side_also_where_it_looks_at_the_middle(surface):
    point, normal = surface(6000)
    turned = normal * np.random.default_rng(0).choice([-1.0, 1.0], len(normal))[:, None]
    settled = turned * settled_signs(point, turned)[:, None]
    assert ((settled * normal).sum(axis=1) > 0).mean() > 0.999
    away = point - (point.min(axis=0) + point.max(axis=0)) / 2
    assert ((away * normal).sum(axis=1) > 0).mean() < 0.95  # what each point by itself would have got wrong


def test_signs__of_parts_that_touch_nowhere_each_look_out():
    point, normal = torus(3000)
    far = np.concatenate([point, point + [100.0, 0.0, 0.0]])
    both = np.concatenate([normal, normal])
    settled = both * settled_signs(far, -both)[:, None]
    assert np.isclose(np.abs((settled * both).sum(axis=1)), 1).all()
    for part in (slice(None, 3000), slice(3000, None)):
        signs = np.sign((settled[part] * both[part]).sum(axis=1))
        assert abs(signs.sum()) == 3000  # one sign a part


@pytest.mark.parametrize("n", [0, 1, 2, 5])
def test_signs__few_points_and_points_on_one_spot_have_some(n):
    point, normal = np.zeros((n, 3)), np.tile([0.0, 0.0, 1.0], (n, 1))
    assert np.isin(settled_signs(point, normal), (-1, 1)).all()
