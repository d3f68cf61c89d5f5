"""Relighting: normals are added up beside colours, and the resolve pass lights what photographs recorded once more.

HPG 2021, section 3.6: "If relighting should be supported, another RGBA16F target can be used to accumulate normals". The
weighted mean of splats that blend smooths their normals as it does their colours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from renderer.effects import ShaderPart

PART = ShaderPart("LIT", ("attribute", "baseline", "resolve"))


@dataclass(frozen=True)
class Light:
    """What colours are times: ambient + diffuse max(0, normal . towards), in linear light."""

    towards: tuple[float, float, float] = (0.0, 0.0, -1.0)  # unit, in camera axes: x right, y down, z forward
    ambient: float = 1.0
    diffuse: float = 0.0


AS_PHOTOGRAPHED = Light()  # a scene that can be lit and is not looks as without


def lamp(right: float, up: float, towards_viewer: float) -> Light:
    """A distant lamp in that direction, as bright as the photographs where a surface faces it."""
    direction = np.array([right, -up, -towards_viewer], float)
    return Light(tuple((direction / np.linalg.norm(direction)).tolist()), ambient=0.3, diffuse=0.7)
