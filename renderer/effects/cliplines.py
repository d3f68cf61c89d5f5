"""The clip test of splats that end at a line: shaders/clipline.glsl reads the line, splat_fragment.glsl tests it."""

from renderer.effects import ShaderPart

PART = ShaderPart("CLIPLINE", ("visibility", "attribute"), flag="clipline")
