"""The shader programs: one for each pass and variant, compiled when first drawn with."""

from __future__ import annotations

import moderngl
import numpy as np

from renderer.splats.glsl import shader_source
from renderer.splats.upload.tables import indices_of_triangles
from storage.packed.schema import GROUP


class Programs:
    """All programs of one context, by name; `attribute atoms=3 clipline` is the pass with its variant."""

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._compiled: dict[str, moderngl.VertexArray | moderngl.ComputeShader] = {}
        self._triangles = context.buffer(indices_of_triangles(GROUP))

    def compute(self, name: str, **defines: int) -> tuple[str, moderngl.ComputeShader]:
        full_name = variant_name(name, defines)
        if full_name not in self._compiled:
            self._compiled[full_name] = self._context.compute_shader(shader_source(f"{name}.comp.glsl", **defines))
        return full_name, self._compiled[full_name]

    def drawing(self, name: str, **defines: int) -> tuple[str, moderngl.VertexArray]:
        """The name of a pass's variant, and its program with the index list of a group's triangles."""
        full_name = variant_name(name, defines)
        if full_name not in self._compiled:
            program = self._context.program(
                vertex_shader=shader_source(f"{name}.vert.glsl", **defines),
                fragment_shader=shader_source(f"{name}.frag.glsl", **defines),
            )
            self._compiled[full_name] = self._context.vertex_array(
                program, [], self._triangles, index_element_size=np.dtype(np.uint16).itemsize
            )
        return full_name, self._compiled[full_name]


def variant_name(name: str, defines: dict[str, int]) -> str:
    """What a shader program is called in the report: its name, and what it was compiled with."""
    words = [name]
    if "N_ATOMS" in defines:
        words.append(f"atoms={defines['N_ATOMS']}")
    for flag, value in defines.items():
        if value and flag != "N_ATOMS":
            words.append(flag.lower().replace("_", " ") + (f"={value}" if value > 1 else ""))
    return " ".join(words)


def set_uniforms(drawing: moderngl.VertexArray, **values) -> None:
    """Set those uniforms that this variant has."""
    for name, value in values.items():
        if name in drawing.program:
            drawing.program[name].value = value
