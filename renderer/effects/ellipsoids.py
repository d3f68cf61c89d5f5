"""Ellipsoids as their outlines, with depth and place on the surface by fragment: shaders/ellipsoid*.glsl."""

from renderer.effects import ShaderPart

PART = ShaderPart("ELLIPSOID", ("visibility", "attribute"), flag="ellipsoid")
