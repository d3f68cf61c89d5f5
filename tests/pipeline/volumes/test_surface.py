"""Points of iso-surfaces against surfaces that are known: where they lie, which way they look, and that none is
missing."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pipeline.geometry.hcp import REACH
from pipeline.volumes.field import SUPPORT
from pipeline.volumes.lattice import HALO, Lattice, auto_size, lattice_of
from pipeline.volumes.surface import sampled, surface_in
from storage.errors import InvalidScan
from tests.pipeline.volumes.made import ball, middle_of

SPACINGS = {"cubes": (1.0, 1.0, 1.0), "flat": (0.5, 0.5, 2.0), "tall": (2.0, 1.0, 0.7)}


def points_of(voxels: np.ndarray, lattice: Lattice, iso: float, task: int = 64, method: str = "trilinear"):
    """Positions and normals in the frame, keys, and how far off the surface, of all slices, `task` at a time."""
    found = []
    for begin in range(0, lattice.counts[2], task):
        end = min(begin + task, lattice.counts[2])
        k0, k1 = lattice.voxel_slices(max(0, begin - HALO), min(lattice.counts[2], end + HALO), SUPPORT)
        slab = voxels[k0:k1].astype(np.float32)
        values, first = sampled(slab, k0, lattice, begin, end, method)
        found.append(surface_in(slab, k0, values, first, lattice, begin, end, iso, method))
    gradient = np.concatenate([s.gradient for s in found]) @ lattice.turn.T
    length = np.linalg.norm(gradient, axis=1, keepdims=True)
    normal = -gradient / np.where(length > 0, length, 1)
    position = lattice.in_frame(np.concatenate([s.position for s in found]))
    return position, normal, np.concatenate([s.key for s in found]), np.concatenate([s.off for s in found])


def in_cubes(voxels: np.ndarray, size: float | None = None) -> Lattice:
    return lattice_of(voxels.shape[::-1], np.eye(3), np.zeros(3), size or auto_size((1.0, 1.0, 1.0)))


@pytest.mark.parametrize("method", ["trilinear", "radial"])
@pytest.mark.parametrize("spacing", SPACINGS.values(), ids=SPACINGS)
def test_surface__of_a_ball_lies_on_it_looks_outwards_and_covers_it(spacing, method):
    shape = tuple(int(22 / s) for s in spacing)
    voxels = ball(shape, spacing)
    lattice = lattice_of(shape, np.diag(spacing), np.zeros(3), auto_size(spacing))
    position, normal, _, off = points_of(voxels, lattice, 50.0, method=method)
    outwards = position - middle_of(shape, spacing)
    radius = np.linalg.norm(outwards, axis=1)
    # Between voxels a trilinear ball is off by curvature: spacing^2 / 8 radius.
    assert np.abs(radius - 7).max() < max(spacing) ** 2 / 56 + 0.03
    assert np.nanmean(off) < 0.002 * lattice.size and np.nanmax(off) < 0.03 * lattice.size
    cosine = (normal * outwards).sum(axis=1) / radius
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 3
    everywhere = np.random.default_rng(0).normal(size=(4000, 3))
    everywhere = 7 * everywhere / np.linalg.norm(everywhere, axis=1, keepdims=True) + middle_of(shape, spacing)
    assert cKDTree(position).query(everywhere)[0].max() < 1.6 * lattice.size


@pytest.mark.parametrize(
    "directions",
    [
        np.diag([-1.0, -1.0, 1.0]),
        np.diag([1.0, 1.0, -1.0]),
        np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
        np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]]) @ np.diag([1.0, 1.0, 1.2]),
        np.array([[1.0, 0, 0], [0, 1, 0.35], [0, 0, 1]]),
    ],
    ids=["LPS", "left-handed", "permuted", "oblique", "tilted"],
)
def test_surface__of_a_ball_is_a_ball_in_every_frame(directions):
    origin = np.array([100.0, -50.0, 7.0])
    shape = (24, 24, 24)
    k, j, i = np.indices(shape[::-1], dtype=np.float64)
    at = np.stack([i, j, k], axis=-1) @ directions.T + origin
    middle = directions @ (np.array(shape) - 1) / 2 + origin
    voxels = np.clip(50 + 10 * (7 - np.linalg.norm(at - middle, axis=-1)), 0, 100)
    lattice = lattice_of(shape, directions, origin, 1.1)
    position, normal, _, _ = points_of(voxels, lattice, 50.0)
    outwards = position - middle
    radius = np.linalg.norm(outwards, axis=1)
    assert len(position) > 300 and np.abs(radius - 7).max() < 0.08
    assert ((normal * outwards).sum(axis=1) / radius).min() > 0.95


def test_surface__is_the_same_whatever_the_slices_are_cut_into():
    voxels = np.random.default_rng(1).uniform(0, 100, (20, 17, 23))
    for method in ("trilinear", "radial"):
        lattice = in_cubes(voxels)
        whole = points_of(voxels, lattice, 50.0, 100, method)
        for task in (8, 11):
            assert all(
                np.array_equal(a, b, equal_nan=True)
                for a, b in zip(whole, points_of(voxels, lattice, 50.0, task, method))
            )
        assert len(np.unique(whole[2])) == len(whole[2])
        assert (np.diff(whole[2]) > 0).all()


def test_surface__points_lie_no_further_than_a_cell_reaches_from_their_cell():
    voxels = np.random.default_rng(2).uniform(0, 100, (20, 17, 23))
    lattice = in_cubes(voxels)
    position, _, key, _ = points_of(voxels, lattice, 50.0)
    from pipeline.geometry.hcp import centres_of

    assert np.linalg.norm(position - centres_of(key, lattice.size), axis=1).max() <= 2 * REACH * lattice.size


@pytest.mark.parametrize("size", [1.1225, 3.0])
def test_surface__features_of_one_voxel_have_points(size):
    """A lone voxel, a wire and a sheet one voxel thick, at every place: each crossing of an edge has a point within two
    cells."""
    rng = np.random.default_rng(3)
    voxels = np.zeros((24, 24, 24))
    lone = rng.integers(2, 22, (12, 3))
    voxels[tuple(lone.T)] = 100
    voxels[5, 9, :] = 100
    voxels[:, :, 17] = np.maximum(voxels[:, :, 17], 80)
    lattice = in_cubes(voxels, size)
    position, _, _, _ = points_of(voxels, lattice, 60.0)
    crossings = []
    for axis in range(3):
        a, b = (np.moveaxis(voxels, axis, 0)[s] for s in (slice(None, -1), slice(1, None)))
        where = np.argwhere((a >= 60) != (b >= 60))
        t = (60 - a[tuple(where.T)]) / (b - a)[tuple(where.T)]
        at = where.astype(float)
        at[:, 0] += t
        crossings.append(
            np.moveaxis(at[:, :, None], 1, 1)[:, np.argsort([axis, *[x for x in range(3) if x != axis]]), 0][:, ::-1]
        )
    crossings = np.concatenate(crossings)
    assert len(crossings) > 1000
    assert cKDTree(position).query(crossings)[0].max() <= (1 + 2 * REACH) * size


def test_surface__a_sharp_edge_does_not_ring_with_the_radial_kernel():
    voxels = np.zeros((16, 16, 40))
    voxels[:, :, 20:] = 3000.0
    lattice = in_cubes(voxels)
    for iso in (30.0, 1500.0, 2950.0):
        position, _, _, _ = points_of(voxels, lattice, iso, method="radial")
        assert len(position) and (position[:, 0] >= 19).all() and (position[:, 0] <= 20).all()


def test_surface__iso_values_equal_to_voxels_and_flat_volumes():
    voxels = np.round(ball((20, 20, 20), radius=6.0) / 10) * 10
    lattice = in_cubes(voxels)
    position, normal, _, _ = points_of(voxels, lattice, 50.0)
    assert np.isfinite(position).all() and np.isfinite(normal).all()
    assert np.abs(np.linalg.norm(position - 9.5, axis=1) - 6).max() < 1
    for flat, iso in ((50.0, 50.0), (50.0, 49.0), (0.0, 1.0)):
        assert not len(points_of(np.full((8, 8, 8), flat), in_cubes(np.zeros((8, 8, 8))), iso)[0])


def test_surface__is_open_around_voxels_that_are_not_known():
    voxels = ball((22, 22, 22))
    voxels[:, :, :11] = np.nan
    position, normal, _, _ = points_of(voxels, in_cubes(voxels), 50.0)
    assert len(position) and np.isfinite(position).all() and np.isfinite(normal).all()
    assert (position[:, 0] >= 11 - 1e-9).all()
    assert np.abs(np.linalg.norm(position - 10.5, axis=1) - 7).max() < 0.1


@pytest.mark.parametrize("shape", [(30, 29, 29), (29, 30, 29), (29, 29, 30), (2, 2, 2), (50, 2, 3)])
def test_surface__of_sizes_that_differ_by_one_and_of_the_smallest(shape):
    """A slanted plane through every voxel has a point wherever it passes."""
    k, j, i = np.indices(shape[::-1], dtype=np.float64)
    voxels = 3.0 * i + 2.0 * j + 1.0 * k
    iso = float(voxels.max() / 2 + 0.25)
    lattice = lattice_of(shape, np.eye(3), np.zeros(3), auto_size((1.0, 1.0, 1.0)))
    position, normal, _, _ = points_of(voxels, lattice, iso)
    assert np.abs(position @ (3, 2, 1) - iso).max() < 0.05
    assert np.allclose(normal, np.array([-3, -2, -1]) / np.sqrt(14), atol=1e-3)
    assert (position >= -1e-9).all() and (position <= np.array(shape) - 1 + 1e-9).all()


def test_lattice__too_many_cells_are_refused_with_the_size_that_fits():
    with pytest.raises(InvalidScan, match="choose a cell of"):
        lattice_of((40_000, 60_000, 4), np.eye(3), np.zeros(3), 1.0)
    with pytest.raises(InvalidScan, match="choose a cell of"):
        lattice_of((100, 100, 100), np.eye(3), np.zeros(3), 1e-5)


def test_field__the_radial_kernel_is_nearer_to_a_signal_that_voxels_hold():
    """Waves of half the highest frequency: RMS error of a twentieth of theirs, where trilinear has a fifth."""
    k, j, i = np.indices((24, 24, 24), dtype=np.float64)

    def signal(x, y, z):
        return (
            50
            + 20 * np.sin(0.5 * np.pi * (0.8 * x + 0.5 * y + 0.3 * z) + 1)
            + 10 * np.cos(0.5 * np.pi * (0.2 * x - 0.9 * y + 0.3 * z))
        )

    voxels = signal(i, j, k).astype(np.float32)
    lattice = lattice_of((24, 24, 24), np.eye(3), np.zeros(3), 0.9)
    rms = {}
    for method in ("trilinear", "radial"):
        values, first = sampled(voxels, 0, lattice, 8, 16, method)
        s, r, c = (x.ravel() for x in np.indices(values.shape))
        from pipeline.geometry.hcp import centres_of, key_of

        keys = np.array(
            [key_of(int(a) + lattice.low[0], int(b) + lattice.low[1], int(d) + first) for a, b, d in zip(c, r, s)]
        )
        centre = centres_of(keys, 0.9)
        inner = ((centre > 4) & (centre < 19)).all(axis=1)
        truth = signal(*centre[inner].T)
        rms[method] = np.sqrt(((values.ravel()[inner] - truth) ** 2).mean()) / truth.std()
    assert rms["radial"] < rms["trilinear"] / 3
