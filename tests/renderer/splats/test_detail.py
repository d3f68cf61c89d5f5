"""Which groups of a scene with levels a view draws, and what its pictures are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from renderer.splats.detail import FADE, FINEST, Detail, GroupTree, group_tree, parents_of, shares_of
from renderer.splats.renderer import Renderer
from renderer.splats.scene import GpuScene
from storage.packed.packed import PackedFile, PackedScene
from storage.packed.schema import GROUP, Camera
from tests.renderer.conftest import N_LEVELLED

SIZE = 160


def view_from(distance: float, header, side: float = 0.0) -> Camera:
    """Down on the surface of a metre from so far above its middle."""
    rotation = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
    return Camera("above", SIZE, SIZE, 200.0, 200.0, SIZE / 2, SIZE / 2, rotation, (0.5 + side, 0.5, distance))


@pytest.fixture(scope="module")
def scenes(levelled_files) -> dict[int, PackedScene]:
    """A wavy surface without levels and with two."""
    made = {}
    for levels, path in levelled_files.items():
        with PackedFile(path) as packed:
            made[levels] = packed.load()
    return made


@pytest.fixture(scope="module")
def drawn(scenes) -> tuple[Renderer, GpuScene]:
    renderer = Renderer()
    return renderer, GpuScene(scenes[2], renderer.context)


def db(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / max(1e-9, np.square(a.astype(float) - b).mean())))


def test_detail__the_file_has_the_levels_and_the_finest_is_that_of_one_without(scenes):
    header = scenes[2].header
    assert header.levels == (GROUP, 4 * GROUP, N_LEVELLED) and header.first_finest == 5 * GROUP
    assert scenes[0].header.levels == () and scenes[0].header.n_finest == N_LEVELLED
    for name in ("position", "normal"):
        assert (scenes[2].arrays[name][5 * GROUP :] == scenes[0].arrays[name]).all()


def test_detail__each_parent_holds_its_children_and_looks_no_smaller(scenes):
    tree = group_tree(scenes[2])
    for child, parent in enumerate(parents_of(scenes[2].header.levels)):
        if parent >= 0:
            assert (tree.low[parent] <= tree.low[child]).all() and (tree.high[parent] >= tree.high[child]).all()
            assert tree.size[parent] > 1.5 * tree.size[child]  # FADE
    assert np.bincount(parents_of(scenes[2].header.levels)[1:]).tolist() == [4, 4, 4, 4, 6]


def random_tree(rng: np.random.Generator) -> tuple[GroupTree, tuple[int, ...]]:
    levels = (2 * GROUP, 9 * GROUP, 38 * GROUP)
    parent = parents_of(levels)
    low = rng.uniform(-5, 5, (len(parent), 3))
    high, size = low + rng.uniform(0, 1, (len(parent), 1)), rng.uniform(0.01, 0.02, len(parent))
    for group in range(len(parent) - 1, -1, -1):
        if (above := parent[group]) >= 0:
            low[above], high[above] = np.minimum(low[above], low[group]), np.maximum(high[above], high[group])
            size[above] = max(size[above], 2 * size[group])
    return GroupTree(low, high, size, parent, np.full(len(parent), GROUP), 38), levels


@pytest.mark.parametrize("seed", range(5))
def test_detail__shares_along_a_path_add_up_to_one(seed, scenes):
    rng = np.random.default_rng(seed)
    tree, _ = random_tree(rng)
    header = replace(scenes[2].header, origin=(0.0, 0.0, 0.0))
    for distance in (0.1, 3.0, 10.0, 40.0, 400.0):
        view = replace(view_from(0, header), centre=tuple(rng.normal(0, 1, 3) * distance))
        shares = shares_of(tree, view, header, Detail())
        assert shares.min() >= 0 and shares.max() <= 1
        for leaf in np.flatnonzero(tree.is_leaf):
            path, group = 0.0, leaf
            while group >= 0:
                path, group = path + shares[group], tree.parent[group]
            assert path == pytest.approx(1, abs=0.26)  # exact but where three levels share
        inside = ((tree.low <= view.centre) & (tree.high >= view.centre)).all(axis=1)
        assert (shares[inside & ~tree.is_leaf] == 0).all()


def test_detail__a_budget_is_kept_and_the_finest_is_the_finest(scenes):
    tree, _ = random_tree(np.random.default_rng(0))
    header = replace(scenes[2].header, origin=(0.0, 0.0, 0.0))
    view = replace(view_from(0, header), centre=(0.0, 0.0, 30.0))
    assert (shares_of(tree, view, header, FINEST) == tree.is_leaf).all()
    counts = []
    for most in (40 * GROUP, 12 * GROUP, 3 * GROUP):
        shares = shares_of(tree, view, header, Detail(0.01, most))
        counts.append(int(tree.n_splats[shares > 0].sum()))
        assert 0 < counts[-1] <= most or counts[-1] <= 3 * GROUP
    assert counts == sorted(counts, reverse=True) and counts[0] > counts[2]


def test_detail__near_views_are_those_of_a_file_without_levels(scenes, drawn):
    renderer, scene = drawn
    plain = GpuScene(scenes[0], renderer.context)
    view = view_from(0.3, scenes[0].header)
    assert db(renderer.render(scene, view, detail=FINEST).rgb, renderer.render(plain, view).rgb) > 55
    assert db(renderer.render(scene, view).rgb, renderer.render(plain, view).rgb) > 55
    plain.release()


@pytest.mark.parametrize("level", [0, 1])
def test_detail__a_level_seen_where_its_splats_are_two_pixels_wide_is_like_the_finest(level, scenes, drawn):
    renderer, scene = drawn
    tree = scene.tree
    size = float(tree.size[[slice(0, 1), slice(1, 5)][level]].max())
    view = view_from(200.0 * size * 1.02 * FADE**0.5 + 0.02, scenes[2].header)  # from where on it is alone
    coarse, fine = renderer.render(scene, view, detail=Detail(1.0)), renderer.render(scene, view, detail=FINEST)
    renderer.render(scene, view, detail=Detail(1.0))
    assert scene.n_chosen <= [GROUP, 4 * GROUP][level]
    inside = coarse.coverage & fine.coverage
    assert (coarse.coverage != fine.coverage).mean() < 0.06
    assert db(coarse.rgb[inside], fine.rgb[inside]) > 28
    assert structural_similarity(coarse.rgb, fine.rgb, channel_axis=2) > 0.85


def test_detail__a_flight_has_no_pops(scenes, drawn):
    renderer, scene = drawn
    header, frames, chosen = scenes[2].header, [], []
    sizes = scene.tree.size[1:5]
    near, far = (
        200 * sizes.min() / FADE**0.5 - 0.02,
        200 * sizes.max() * FADE**0.5 + 0.03,
    )  # over which the middle level takes the finest's place
    for distance in np.linspace(near, far, 12):
        frames.append(renderer.render(scene, view_from(distance, header)).rgb.astype(float))
        chosen.append(scene.n_chosen)
    assert chosen[0] == N_LEVELLED and chosen[-1] == 4 * GROUP
    finest = [
        renderer.render(scene, view_from(d, header), detail=FINEST).rgb.astype(float)
        for d in np.linspace(near, far, 12)
    ]
    steps, usual = ([np.abs(b - a).mean() for a, b in zip(f, f[1:])] for f in (frames, finest))
    assert max(s - u for s, u in zip(steps, usual)) < 2
