"""Layers upon layers: pictures against the float64 twin, and what colours are added up in. Bounds: docs/NUMERICS.md."""

from __future__ import annotations

import numpy as np
import pytest

from renderer.splats.renderer import Renderer
from renderer.splats.scene import GpuScene
from renderer.splats.stacks import has_stacks
from renderer.splats.targets import NARROW, WIDE
from storage.packed.schema import Camera
from tests import reference
from tests.renderer.reference_renderer import render
from tests.scenes import Settings, Splats, build_scene, camera_looking

COLORS = {"black": (0, 0), "dark": (1, 6), "middle": (100, 160), "bright": (230, 255), "white": (255, 255)}
VIEW = camera_looking((0, -1, 0), (0, 0, 0), (24, 18), (60, 60))


def stack(n: int, color: str, alike: bool, spread: float, seed: int = 0) -> Splats:
    """n splats on top of each other, within the depth margin."""
    rng = np.random.default_rng(seed)
    low, high = COLORS[color]
    colors = rng.integers(low, high + 1, (1 if alike else n, 3)) * np.ones((n, 1))
    position = rng.uniform(-1, 1, (n, 3)) * [spread, 1e-4, spread]
    return Splats(position, np.tile([0.0, -1, 0], (n, 1)), colors.astype(np.uint8))


def drawn(renderer, scene, view=VIEW):
    gpu_scene = GpuScene(scene, renderer.context)
    picture = renderer.render(gpu_scene, view)
    gpu_scene.release()
    return picture


@pytest.mark.parametrize("n", [1, 10, 100, 1000])
@pytest.mark.parametrize("color", COLORS)
def test_blending__layers_are_within_1_of_255_of_exact_sums(renderer, n, color):
    for alike, spread in ((True, 0.0), (False, 0.0), (True, 0.05)):
        scene = build_scene(stack(n, color, alike, spread))
        picture, (expected, covered) = drawn(renderer, scene), render(scene, VIEW)
        assert (picture.coverage == covered).mean() > 0.995
        both = picture.coverage & covered
        assert both.any() and np.abs(picture.rgb / 255 - expected)[both].max() <= 1 / 255 + 1e-6
        assert picture.accumulation == (WIDE if n >= 100 else NARROW)


def test_blending__sums_in_half_floats_break_at_a_thousand_bright_layers(renderer, monkeypatch):
    """The naive formulation: the paper's RGBA16F whatever the overdraw."""
    scene = build_scene(stack(1000, "bright", True, 0.0))
    expected, covered = render(scene, VIEW)
    for module in ("renderer", "scene"):
        monkeypatch.setattr(f"renderer.splats.{module}.WIDE", NARROW)
    picture = drawn(renderer, scene)
    assert np.abs(picture.rgb / 255 - expected)[covered & picture.coverage].max() > 5 / 255


def test_blending__half_float_sums_are_within_1_of_255_up_to_a_weight_of_16():
    rng = np.random.default_rng(1)
    worst = {16: 0.0, 400: 0.0}
    for most in worst:
        for _ in range(200):
            weight = rng.uniform(0.3, 1, 5 * most)
            weight = weight[np.cumsum(weight) <= most]
            linear = np.full(len(weight), rng.uniform(0, 1))
            off = reference.srgb(reference.half_float_mean(linear, weight)) - reference.srgb(
                (linear * weight).sum() / weight.sum()
            )
            worst[most] = max(worst[most], abs(off))
    assert worst[16] <= 1 / 255 < worst[400]


def test_blending__rims_of_a_thousand_layers_that_differ_stay_narrow_and_within_1_of_255():
    """Nothing but rims adds up to a weight below 16, so sums are narrow; where layers are copies, roundings add up
    too."""
    rng = np.random.default_rng(0)
    off = []
    for n in (30, 100, 300, 1000):
        for mean in (0.02, 0.2, 0.5, 1.0):
            weight = rng.uniform(0, 24 / n, n)
            linear = np.clip(rng.normal(mean, 0.1 * mean, n), 0, 1)
            assert weight.sum() < 16
            off.append(
                reference.srgb(reference.half_float_mean(linear, weight))
                - reference.srgb((linear * weight).sum() / weight.sum())
            )
    copies = reference.srgb(reference.half_float_mean(np.full(100, 0.616), np.full(100, 0.0278))) - reference.srgb(
        0.616
    )
    assert np.abs(off).max() <= 1 / 255 < abs(copies)


# A strip of pixels where splats at the origin, 160 px of radius, weigh 0.010 to 0.014.
RIM = Camera("rim", 20, 1, 1600.0, 1600.0, 10.0, -158.4, ((1.0, 0, 0), (0, 0, -1.0), (0, 1.0, 0)), (0.0, -1.0, 0.0))


@pytest.mark.parametrize("n", [1, 10, 30, 100, 1000])
@pytest.mark.parametrize("color", COLORS)
def test_blending__rims_of_copies_are_within_1_of_255_of_exact_sums(renderer, n, color):
    """A picture of rims alone, whose weights stay below 16 whatever the layers: copies are told by their positions."""
    for alike, spread in ((True, 0.0), (False, 0.0), (True, 1e-4), (True, 1e-3)):
        scene = build_scene(stack(n, color, alike, spread))
        picture, (expected, covered) = drawn(renderer, scene, RIM), render(scene, RIM)
        both = picture.coverage & covered
        assert both.any() and np.abs(picture.rgb / 255 - expected)[both].max() <= 1 / 255 + 1e-6
        assert picture.accumulation == (WIDE if n >= 100 else NARROW if n <= 10 else picture.accumulation)


def test_blending__rims_of_copies_break_where_overdraw_is_told_by_weight_alone(renderer, monkeypatch):
    """The naive formulation: sums are narrow until a pixel's weight reaches 16."""
    monkeypatch.setattr("renderer.splats.scene.has_stacks", lambda scene: False)
    scene = build_scene(stack(1000, "bright", True, 0.0))
    picture, (expected, covered) = drawn(renderer, scene, RIM), render(scene, RIM)
    assert picture.accumulation == NARROW
    assert np.abs(picture.rgb / 255 - expected)[covered & picture.coverage].max() > 5 / 255


@pytest.mark.parametrize("n", [10, 41, 128, 300])
@pytest.mark.parametrize("jitter", [0.0, 1e-4])
@pytest.mark.parametrize("seed", range(4))
def test_blending__stacks_are_found_wherever_chunks_and_cells_part_them(n, jitter, seed):
    rng = np.random.default_rng(seed)
    copies = rng.uniform(-1, 1, 3) * [1, 0, 1] + jitter * rng.uniform(-1, 1, (n, 3)) * [1, 0, 1]
    others = rng.uniform(-1, 1, (700, 3)) * [1, 0, 1]
    position = np.concatenate([copies, others])
    scene = build_scene(Splats(position, np.tile([0.0, -1, 0], (len(position), 1))), Settings(radius=0.05))
    assert has_stacks(scene) == (n > 10)


def test_blending__what_is_no_stack_is_none():
    rng = np.random.default_rng(0)
    for position in (
        rng.uniform(-1, 1, (5000, 3)) * [1, 0, 1],
        np.repeat(rng.uniform(-1, 1, (300, 3)), 4, axis=0),
        np.stack(np.meshgrid(*[np.linspace(-1, 1, 60)] * 2, [0]), -1).reshape(-1, 3),
    ):
        assert not has_stacks(
            build_scene(Splats(position, np.tile([0.0, -1, 0], (len(position), 1))), Settings(radius=0.03))
        )


def test_blending__a_scene_once_overdrawn_keeps_its_wide_sums_and_others_do_not(renderer):
    many, few = (build_scene(stack(n, "bright", True, 0.0)) for n in (200, 5))
    scenes = [GpuScene(scene, renderer.context) for scene in (many, few)]
    found = [renderer.render(scenes[i], VIEW).accumulation for i in (0, 1, 0, 1)]
    beside = renderer.render(scenes[0], camera_looking((0, -1, 0), (0, -2, 0), (24, 18)))
    for scene in scenes:
        scene.release()
    assert found == [WIDE, NARROW, WIDE, NARROW] and beside.accumulation == WIDE


def test_blending__two_renderers_draw_the_same(renderer):
    scene = build_scene(stack(50, "middle", False, 0.05))
    assert (drawn(renderer, scene).rgb == drawn(Renderer(), scene).rgb).all()


@pytest.mark.parametrize("scale", [1e-11, 1e-6, 1e6, 1e14])
def test_blending__no_nan_and_no_inf_reach_a_picture_at_any_scale(renderer, scale):
    splats = stack(30, "middle", False, 0.3)
    scene = build_scene(
        Splats(splats.position * scale, splats.normal, splats.color),
        Settings(radius=0.1 * scale, depth_margin=0.05 * scale),
    )
    view = camera_looking((0.3 * scale, -1.2 * scale, 0.2 * scale), (0, 0, 0), (24, 18), (30, 30))
    picture = drawn(renderer, scene, view)
    with renderer.context:
        kind = np.float16 if picture.accumulation == NARROW else np.float32
        assert np.isfinite(np.frombuffer(renderer._targets.sums.read(), kind)).all()
    expected, covered = render(scene, view)
    both = covered & picture.coverage
    assert both.mean() > 0.1 and np.median(np.abs(picture.rgb / 255 - expected)[both]) <= 1 / 255
