"""Shader sources: includes, variants, and what a variant must not hold."""

import re
from importlib.resources import files

import numpy as np
import pytest

from renderer.splats.glsl import shader_source


def test_shader_source__fills_in_every_include():
    for path in files("renderer").joinpath("shaders").iterdir():
        text = shader_source(path.name)
        assert "#include" not in text and text.startswith("#version 430\n")


def test_shader_source__defines_what_is_not_zero():
    text = shader_source("attribute.frag.glsl", N_ATOMS=3, CLIPLINE=0)
    assert "#define N_ATOMS 3" in text and "#define CLIPLINE" not in text


def test_attribute_shader__without_atoms_compiles_no_sampler(renderer):
    """Asked of the driver: its 0-atom program has no active sampler and no code stream; the 1-atom program has both."""
    active = {}
    with renderer.context:
        for n_atoms in (0, 1):
            program = renderer.context.program(
                vertex_shader=shader_source("attribute.vert.glsl", N_ATOMS=n_atoms, BY_BATCH=1),
                fragment_shader=shader_source("attribute.frag.glsl", N_ATOMS=n_atoms, BY_BATCH=1),
            )
            active[n_atoms] = set(program)
            program.release()
    assert not any({"atlas", "Codes"} & active[0]) and {"atlas", "Codes"} <= active[1]


@pytest.mark.parametrize("name", ["visibility", "attribute", "baseline"])
def test_shaders__without_cliplines_have_no_clip_test(renderer, name):
    for clipline in (0, 1):
        with renderer.context:
            program = renderer.context.program(
                vertex_shader=shader_source(f"{name}.vert.glsl", CLIPLINE=clipline, BY_BATCH=1),
                fragment_shader=shader_source(f"{name}.frag.glsl", CLIPLINE=clipline, BY_BATCH=1),
            )
            assert bool({"Cliplines", "Lines"} & set(program)) == bool(clipline)
            program.release()


def test_linear_light__of_the_shader_is_that_of_srgb_to_a_fiftieth_of_a_level():
    """The polynomial as the shader's text has it, against the power of the standard, both back in levels of 255."""
    numbers = re.search(r"vec3 power = (.*);", shader_source("srgb.glsl"))[1]
    srgb = np.linspace(0.04045, 1, 10_001)
    found, exact = eval(numbers, {"srgb": srgb}), ((srgb + 0.055) / 1.055) ** 2.4
    encoded = [1.055 * linear ** (1 / 2.4) - 0.055 for linear in (found, exact)]
    assert 255 * np.abs(encoded[0] - encoded[1]).max() <= 0.02
