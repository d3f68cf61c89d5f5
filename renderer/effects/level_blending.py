"""Blended levels: a splat between two mip levels of its atoms has both looked up and mixed (atom_texture.glsl), else
the nearer one."""

from renderer.effects import ShaderPart

PART = ShaderPart("BLENDED", ("attribute",))
