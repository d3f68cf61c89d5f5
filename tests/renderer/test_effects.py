"""Shader parts: what no scene calls for is in no program, and what one asks for is."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.effects.registry import effects
from renderer.effects import defines_of, shader_parts
from renderer.effects.relighting import lamp
from renderer.glsl import shader_source
from renderer.scene import GpuScene
from storage.schema import EXTRAS, Batch
from tests.scenes import build_scene, camera_looking, sheet

VIEW = camera_looking((0.1, -1.2, 0.2), (0, 0, 0))


def asked_for(scene, **found):
    return replace(scene, header=replace(scene.header, effects=found))


def drawn(renderer, scene, **more):
    gpu_scene = GpuScene(scene, renderer.context)
    picture = renderer.render(gpu_scene, VIEW, **more)
    gpu_scene.release()
    return picture


@pytest.fixture(scope="module")
def plain():
    return build_scene(sheet(np.random.default_rng(0), 200, tilt=0.05))


def test_parts__are_those_of_effects_or_of_what_the_file_may_hold():
    assert shader_parts() and set(shader_parts()) <= set(effects()) | {extra.stream for extra in EXTRAS}
    flags = {extra.flag for extra in EXTRAS}
    assert all(part.flag is None or part.flag in flags for part in shader_parts().values())


def test_parts__stand_behind_their_define_in_the_shaders_of_their_passes():
    for part in shader_parts().values():
        for stage in part.passes:
            with_it, without = ("".join(shader_source(f"{stage}.{kind}.glsl", **{part.define: on}) for kind in ("vert", "frag"))
                                for on in (1, 0))
            assert f"#define {part.define} 1" in with_it and f"#define {part.define}" not in without
            assert part.define in without, "the define is tested nowhere in this pass"


def test_parts__are_in_no_program_of_a_scene_without_effects(renderer, plain):
    picture = drawn(renderer, plain)
    assert picture.programs == ("cull", "visibility", "attribute atoms=0", "resolve watched") and picture.accumulation == "RGBA16F"
    assert list(picture.pass_seconds) == ["cull", "visibility", "attribute", "resolve"]
    assert not any(defines_of(stage, frozenset(), Batch(0)).get(part.define) for part in shader_parts().values()
                   for stage in part.passes)


def test_relighting__as_photographed_changes_no_pixel(renderer, plain):
    lit = drawn(renderer, asked_for(plain, relighting={}))
    assert "attribute atoms=0 lit" in lit.programs and "resolve lit watched" in lit.programs
    assert np.array_equal(lit.rgb, drawn(renderer, plain).rgb)


def test_relighting__a_lamp_lights_what_faces_it(renderer, plain):
    scene = asked_for(plain, relighting={})
    front, side, behind = (drawn(renderer, scene, light=lamp(*to)).rgb.astype(float).mean()
                           for to in ((0, 0, 1), (1, 0, 0.3), (0, 0, -1)))
    assert front > 1.1 * side > 1.1 * behind > 0
    assert front == pytest.approx(drawn(renderer, plain).rgb.mean(), rel=0.03)


def test_accumulation__asked_for_is_wide_from_the_start(renderer, plain):
    assert drawn(renderer, asked_for(plain, accumulation={})).accumulation == "RGBA32F"
