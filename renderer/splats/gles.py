"""The same shaders for WebGL 2: the GLSL of renderer/shaders as GLSL ES 3.00, text by text, so that there is one
source.

What ES lacks is put in other words: storage buffers become textures of whole numbers, a line of 2048 texels after the
other, and `buffer[i]` becomes `load(buffer, i)`; bindings go; a vertex's number counts three a splat, as draws have no
index list and no base vertex there. Where clip space cannot end at 0 (no EXT_clip_control), fragments write their depth
themselves.

The defines of a variant are put on top by whoever compiles: effects are #ifdefs here as they are there.
"""

from __future__ import annotations

import re
from dataclasses import asdict
from functools import cache

from renderer.effects import shader_parts
from renderer.splats.glsl import with_includes

PASSES = ("visibility", "attribute", "resolve")
# The viewer draws no page files, both sides of discs, and all splats of maps by one program; it has no compute shaders.
NOT_DRAWN = (
    "pages.vert.glsl", "pages.frag.glsl", "front.vert.glsl", "unmapped.glsl", "unmapped.vert.glsl", "decoded_quadric.glsl"
)  # fmt: skip
VERSION = "#version 300 es"
LINE_BITS = 11  # textures are 2048 texels wide, which every WebGL 2 has
_HEAD = f"""precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;
precision highp sampler2DArray;
precision highp usampler2DArray;
#define precise
#define load(buffer, i) texelFetch(buffer, ivec2(int(i) & {2**LINE_BITS - 1}, int(i) >> {LINE_BITS}), 0).r
#define load_pair(buffer, i) texelFetch(buffer, ivec2(int(i) & {2**LINE_BITS - 1}, int(i) >> {LINE_BITS}), 0).rg
#define load_float(buffer, i) uintBitsToFloat(load(buffer, i))
"""
_VERTEX_HEAD = """int vertex_number() { return gl_VertexID / 3 * 4 + gl_VertexID % 3; }  // of four, as index lists count
#ifdef OWN_DEPTH
flat out float nearness;
#define KEEP_DEPTH nearness = gl_Position.z; gl_Position.z = 2.0 * gl_Position.z - gl_Position.w;
#else
#define KEEP_DEPTH
#endif
"""
_FRAGMENT_HEAD = """#ifdef OWN_DEPTH
flat in float nearness;
#define DEPTH_HERE (nearness * gl_FragCoord.w)
#define KEEP_DEPTH gl_FragDepth = DEPTH_HERE;
#else
#define DEPTH_HERE gl_FragCoord.z
#define KEEP_DEPTH
#endif
"""
_COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*", re.DOTALL)
_SPACE = re.compile(r" ?([*/=<>?:;,(){}|&!]) ?")
_BUFFER = re.compile(r"layout\(std430, binding = \d+\) readonly buffer \w+ \{ (\w+) (\w+)\[\]; \};")
_LOADS = {"uint": "load", "uvec2": "load_pair", "float": "load_float"}


@cache
def es_sources() -> dict[str, str]:
    """Each shader's text without version and defines, by the name of its file without `.glsl`."""
    names = [f"{name}.{kind}" for kind in ("vert", "frag") for name in PASSES]  # alike ones beside each other, for gzip
    return {name: to_es(drawn_text(f"{name}.glsl"), name.endswith(".vert")) for name in names}


@cache
def drawn_text(name: str) -> str:
    """The text of a shader with its includes but those of NOT_DRAWN, which stand behind defines that the viewer sets
    never."""
    text = with_includes(name)
    for part in NOT_DRAWN:
        text = text.replace(with_includes(part), "")
    return text


def shader_document() -> dict:
    """What the viewer takes: version, texts, and what each effect adds to which passes."""
    parts = {name: asdict(part) for name, part in shader_parts().items()}
    sources = {name: _close(text) for name, text in es_sources().items()}
    return {"version": VERSION, "line_bits": LINE_BITS, "sources": sources, "parts": parts}


def _close(text: str) -> str:
    """Without spaces about signs, but on lines of the preprocessor."""
    return "\n".join(line if line.startswith("#") else _SPACE.sub(r"\1", line) for line in text.split("\n"))


def to_es(text: str, is_vertex: bool) -> str:
    """One shader, its includes filled in, as GLSL ES without version."""
    text = _loads(text)
    text = _BUFFER.sub(lambda match: f"uniform highp usampler2D {match[2]};", text)
    text = text.replace("layout(depth_less) out float gl_FragDepth;", "")
    text = re.sub(r"layout\(binding = \d+\) uniform", "uniform", text)
    text = re.sub(r"layout\(std140, binding = \d+\)", "layout(std140)", text)
    if is_vertex:
        text = text.replace("gl_VertexID", "vertex_number()").replace(
            "gl_Position = quad.clip;", "gl_Position = quad.clip; KEEP_DEPTH"
        )
        return _bare(_HEAD + _VERTEX_HEAD + text)
    text = text.replace("gl_FragCoord.z", "DEPTH_HERE")
    if "splat_fragment" in text or "squared_distance()" in text:
        text = text.replace("void main() {", "void main() {\n    KEEP_DEPTH", 1)
    return _bare(_HEAD + _FRAGMENT_HEAD + text)


def _bare(text: str) -> str:
    """The text without comments, indentation and empty lines: it goes over the network, and into each page of its
    own."""
    lines = (line.strip() for line in _COMMENT.sub("", text).splitlines())
    return "\n".join(line for line in lines if line) + "\n"


def _loads(text: str) -> str:
    """`name[i]` of every storage buffer as a load from its texture. A buffer may be declared twice, behind an #ifdef: a
    load is of the kind of the last declaration before it."""
    names = {match[2] for match in _BUFFER.finditer(text)} | {"(words)"}  # the last is a macro's parameter
    indexed = re.compile(r"(?<![\w.])(" + "|".join(map(re.escape, sorted(names))) + r")\[(?!\])")
    at = 0
    while match := indexed.search(text, at):
        kinds = [found[1] for found in _BUFFER.finditer(text, 0, match.start()) if found[2] == match[1]]
        load, end = _LOADS[kinds[-1] if kinds else "uint"], _bracketed(text, match.end())
        inside = text[match.end() : end]
        text = f"{text[: match.start()]}{load}({match[1].strip('()')}, {inside}){text[end + 1 :]}"
        at = match.start() + len(load)
    return text


def _bracketed(text: str, start: int) -> int:
    """Where the bracket that opens before `start` closes."""
    depth = 1
    for at in range(start, len(text)):
        depth += {"[": 1, "]": -1}.get(text[at], 0)
        if depth == 0:
            return at
    raise AssertionError("a bracket that does not close")
