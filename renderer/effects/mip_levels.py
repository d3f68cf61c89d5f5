"""Mip levels: atoms are looked up in the level that a splat's size on the screen asks for (atom_texture.glsl)."""

from renderer.effects import ShaderPart

PART = ShaderPart("LEVELS", ("attribute",))
