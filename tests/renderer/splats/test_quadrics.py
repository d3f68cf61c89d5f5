"""Splats over quadrics are drawn as the twin does, and as those in boxes; their tables are refused where they are not
sound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from renderer.splats.scene import DECODED, GpuScene
from renderer.splats.stacks import has_stacks
from renderer.splats.upload import quadrics
from storage.packed.scene import check_tables
from storage.packed.schema import GROUP
from tests.renderer.splats.test_renderer import assert_agrees
from tests.scenes import Settings, build_scene, camera_looking, coded, random_dictionary, sheet

VIEW = camera_looking((0.3, -1.2, 0.4), (0, 0, 0))


def mixed(color_step: int, quadric_error: float | None = 1 / 30):
    """Discs, discs with a clipline and ellipsoids, of sizes of their own."""
    rng = np.random.default_rng(8)
    axes, line = np.tile(np.diag([0.12, 0.06, 0.03])[[0, 2, 1]], (150, 1, 1)), np.tile([0.8, 0.6, 0.1], (150, 1))
    axes[50:] = np.nan
    line[:100] = np.nan
    splats = sheet(rng, 150, size=0.05 * 2 ** rng.random(150), axes=axes, clipline=line, **coded(rng, 150, max_atoms=2))
    return build_scene(
        splats, Settings(radius=0.1, color_step=color_step, quadric_error=quadric_error), random_dictionary(rng)
    )


def test_quadrics__are_drawn_as_the_twin_does(renderer):
    scene = mixed(112)
    check_tables(scene)
    assert_agrees(renderer, scene, VIEW)


def test_quadrics__are_drawn_alike_by_windows_of_any_size(renderer, monkeypatch):
    rng = np.random.default_rng(11)
    n = 2 * GROUP + 500
    splats = sheet(rng, n, **coded(rng, n, max_atoms=2))
    scene = build_scene(splats, Settings(radius=0.02, quadric_error=1 / 30), random_dictionary(rng))
    views = [VIEW, camera_looking((0.1, 0.9, 0.2), (0.4, 0.3, 0))]
    pictures, sizes = [], []
    for window in (quadrics.WINDOW, 1, 2):
        monkeypatch.setattr(quadrics, "WINDOW", window)
        gpu_scene = GpuScene(scene, renderer.context)
        pictures.append([renderer.render(gpu_scene, view).rgb for view in views])
        sizes.append(gpu_scene.buffers[DECODED].size)
        gpu_scene.release()
    assert pictures[0][0].any() and (pictures[0][0] != pictures[0][1]).any()
    for found in pictures[1:]:
        for one, other in zip(found, pictures[0], strict=True):
            assert np.abs(one.astype(int) - other).max() <= 1  # sums of colours in another order
    assert sizes == [3 * GROUP * quadrics.SPLAT_BYTES, GROUP * quadrics.SPLAT_BYTES, 2 * GROUP * quadrics.SPLAT_BYTES]


def test_quadrics__take_fewer_bytes_of_a_gpu_than_boxes(renderer):
    n_bytes = []
    for scene in (mixed(112, None), mixed(112)):
        gpu_scene = GpuScene(scene, renderer.context)
        n_bytes.append(gpu_scene.bytes_by_part["geometry"])
        gpu_scene.release()
    assert n_bytes[1] < n_bytes[0]


def test_quadrics__copies_are_told():
    splats = sheet(np.random.default_rng(2), 300)
    assert not has_stacks(build_scene(splats, Settings(radius=0.02, quadric_error=1 / 30)))
    stacked = replace(splats, position=np.concatenate([splats.position[:200], np.tile(splats.position[:1], (100, 1))]))
    assert has_stacks(build_scene(stacked, Settings(radius=0.02, quadric_error=1 / 30)))


@pytest.mark.parametrize("name", ["frame_cells", "frame_step", "frame_bits"])
def test_quadrics__frames_that_are_none_are_refused(name):
    scene = mixed(0)
    values = scene.arrays[name].copy()
    values[0] = 0
    with pytest.raises(ValueError, match=name):
        check_tables(replace(scene, arrays=scene.arrays | {name: values}))
