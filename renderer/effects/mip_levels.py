"""Mip levels: atoms are looked up in the level that a splat's size on the screen asks for, and in the next (atom_texture.glsl)."""

from renderer.effects import ShaderPart

PART = ShaderPart("LEVELS", ("attribute",))
