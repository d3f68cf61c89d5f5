"""Smoothed normals: added up as colours are in a target of their own, and the resolve pass lights each pixel
(resolve.frag.glsl)."""

from renderer.effects import ShaderPart

PART = ShaderPart("SMOOTH", ("attribute", "baseline", "resolve"))
