"""The shaders as GLSL ES: what ES lacks is gone, and the rest is the text of the shaders themselves."""

import re

import pytest

from renderer.effects import shader_parts
from renderer.splats.gles import drawn_text, es_sources, shader_document, to_es


@pytest.mark.parametrize("name", sorted(es_sources()))
def test_gles__leaves_nothing_that_es_lacks(name):
    text = es_sources()[name]
    for word in ("std430", "readonly buffer", "binding =", "depth_less", "#version", "#include"):
        assert word not in text, word
    assert not re.search(r"\bprecise\b(?!\n)", text.replace("precise vec3", "")), "erased by a define"
    vertices = text.replace("int vertex_number() { return gl_VertexID / 3 * 4 + gl_VertexID % 3; }", "")
    assert "gl_VertexID" not in vertices


def test_gles__keeps_every_line_that_reads_no_buffer():
    """But for comments, indentation and empty lines, which nobody needs over a network."""
    source, text = drawn_text("attribute.vert.glsl"), es_sources()["attribute.vert"]
    lines = [line for line in source.splitlines() if "[" not in line and "layout(" not in line and "gl_" not in line]
    lines = [line.partition("//")[0].strip() for line in lines if not line.strip().startswith(("/*", "*"))]
    assert len(lines) > 200
    assert {line for line in lines if line} <= set(text.splitlines())
    assert "//" not in text and "/*" not in text and "\n\n" not in text and "\n " not in text


def test_gles__loads_of_a_buffer_are_of_the_kind_it_was_last_declared():
    text = """#ifdef A
layout(std430, binding = 0) readonly buffer Splats { uint splats[]; };
uint first(uint i) { return splats[i + splats[i]]; }
#else
layout(std430, binding = 0) readonly buffer Splats { uvec2 splats[]; };
uvec2 first(uint i) { return splats[i]; }
#endif
layout(std430, binding = 1) readonly buffer Weights { float weights[]; };
#define READ(words, i) ((words)[(i) >> 5])
uint second(vec2 v[2]) { return READ(splats, uint(weights[0u])) + uint(v[1].x); }
"""
    es = to_es(text, is_vertex=True)
    assert "return load(splats, i + load(splats, i)); }" in es
    assert "return load_pair(splats, i); }" in es
    assert "(load(words, (i) >> 5))" in es
    assert "READ(splats, uint(load_float(weights, 0u))) + uint(v[1].x)" in es
    assert es.count("uniform highp usampler2D splats;") == 2


def test_gles__tells_the_viewer_what_each_effect_adds():
    document = shader_document()
    assert document["version"] == "#version 300 es" and set(document["parts"]) == set(shader_parts())
    assert document["parts"]["cliplines"] == {
        "define": "CLIPLINE",
        "passes": ("visibility", "attribute"),
        "flag": "clipline",
    }
