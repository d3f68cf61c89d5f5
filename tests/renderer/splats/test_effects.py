"""Shader parts: what no scene calls for is in no program, and what one asks for is."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.effects.plan.registry import effects
from renderer.effects import defines_of, shader_parts
from renderer.effects.relighting import lamp
from renderer.splats.glsl import shader_source
from renderer.splats.scene import GpuScene
from storage.packed.schema import EXTRAS, Batch
from tests.scenes import Settings, build_scene, camera_looking, coded, random_dictionary, sheet

VIEW = camera_looking((0.1, -1.2, 0.2), (0, 0, 0))


def asked_for(scene, **found):
    return replace(scene, header=replace(scene.header, effects=found))


def drawn(renderer, scene, **more):
    gpu_scene = GpuScene(scene, renderer.context)
    picture = renderer.render(gpu_scene, VIEW, **more)
    gpu_scene.release()
    return picture


def test_smoothing__one_colour_under_a_lamp_has_no_rims_of_splats(renderer):
    """Splats of a plane with scattered normals: lit one by one each shows its own shade, blended normals are those of
    the plane."""
    rng = np.random.default_rng(7)
    scattered = sheet(rng, 4000, tilt=0.25)
    scene = build_scene(replace(scattered, color=np.full((4000, 3), 180, np.uint8)))
    spread = {}
    for name, more in (("own", {}), ("smooth", {"normal_smoothing": {}})):
        picture = drawn(renderer, asked_for(scene, relighting={}, **more), light=lamp(1, 1, 0.2))
        spread[name] = np.abs(np.diff(picture.rgb[..., 0].astype(float), axis=1))[
            picture.coverage[:, 1:] & picture.coverage[:, :-1]
        ].mean()
    assert 0 < spread["smooth"] < spread["own"]


def test_smoothing__without_a_light_to_be_is_nothing(renderer, plain):
    assert not any("smooth" in name for name in drawn(renderer, asked_for(plain, normal_smoothing={})).programs)


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
            with_it, without = (
                "".join(shader_source(f"{stage}.{kind}.glsl", **{part.define: on}) for kind in ("vert", "frag"))
                for on in (1, 0)
            )
            assert f"#define {part.define} 1" in with_it and f"#define {part.define}" not in without
            assert part.define in without, "the define is tested nowhere in this pass"


def test_parts__are_in_no_program_of_a_scene_without_effects(renderer, plain):
    picture = drawn(renderer, plain)
    assert (
        picture.programs == ("cull", "visibility", "attribute atoms=0", "resolve watched")
        and picture.accumulation == "RGBA16F"
    )
    assert list(picture.pass_seconds) == ["cull", "visibility", "attribute", "resolve"]
    assert not any(
        defines_of(stage, frozenset(), Batch(0)).get(part.define)
        for part in shader_parts().values()
        for stage in part.passes
    )


def test_relighting__as_photographed_changes_no_pixel(renderer, plain):
    lit = drawn(renderer, asked_for(plain, relighting={}))
    assert "attribute atoms=0 lit" in lit.programs and "resolve watched" in lit.programs
    smooth = drawn(renderer, asked_for(plain, relighting={}, normal_smoothing={}))
    assert "attribute atoms=0 smooth lit" in smooth.programs and "resolve smooth watched" in smooth.programs
    assert np.array_equal(smooth.rgb, drawn(renderer, plain).rgb) and np.array_equal(lit.rgb, smooth.rgb)


@pytest.mark.parametrize("more", [{}, {"normal_smoothing": {}}])
def test_relighting__a_lamp_lights_what_faces_it(renderer, plain, more):
    scene = asked_for(plain, relighting={}, **more)
    front, side, behind = (
        drawn(renderer, scene, light=lamp(*to)).rgb.astype(float).mean() for to in ((0, 0, 1), (1, 0, 0.3), (0, 0, -1))
    )
    assert front > 1.1 * side > 1.1 * behind > 0
    assert front == pytest.approx(drawn(renderer, plain).rgb.mean(), rel=0.03)


def with_levels(scene, coarsest: int):
    """The scene without the mip levels below a size."""
    header = replace(scene.header, coarsest_size=coarsest)
    kept = {
        name: values
        for name, values in scene.arrays.items()
        if not name.startswith("atoms_") or int(name[6:]) >= coarsest
    }
    return type(scene)(header, kept)


def levels_off(a, b) -> int:
    """Of 255, at the pixel where two pictures differ most."""
    return int(np.abs(a.rgb.astype(int) - b.rgb).max())


@pytest.mark.parametrize("distance, coarsest", [(0.6, 32), (3.0, 8), (6.0, 4)])
def test_mip_levels__that_no_splat_reaches_change_no_pixel(renderer, distance, coarsest):
    rng = np.random.default_rng(3)
    scene = build_scene(
        sheet(rng, 150, tilt=0.05, half_width=0.1, **coded(rng, 150)), Settings(), random_dictionary(rng)
    )
    view = camera_looking((0, -distance, 0), (0, 0, 0), (96, 72), (100, 100))
    pictures = {}
    for name, shown in (
        ("all", scene),
        ("reached", with_levels(scene, coarsest)),
        ("one less", with_levels(scene, min(32, 2 * coarsest))),
    ):
        gpu_scene = GpuScene(shown, renderer.context)
        pictures[name] = renderer.render(gpu_scene, view)
        gpu_scene.release()
    assert (
        levels_off(pictures["all"], pictures["reached"]) <= 1 and pictures["all"].coverage.any()
    )  # the atlas is as high as it has levels:
    # coordinates in it round otherwise, and GPUs filter by weights of 8 bits
    if coarsest == 32:
        assert not any("levels" in name for name in pictures["reached"].programs)
    else:
        assert levels_off(pictures["all"], pictures["one less"]) > 1, "the level before does not do"


def test_accumulation__asked_for_is_wide_from_the_start(renderer, plain):
    assert drawn(renderer, asked_for(plain, accumulation={})).accumulation == "RGBA32F"
