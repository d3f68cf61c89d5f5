"""Relighting: what photographs recorded is lit once more, splat by splat or, with smoothed normals, pixel by pixel.

HPG 2021, section 3.6: "If relighting should be supported, another RGBA16F target can be used to accumulate normals".
The weighted mean of splats that blend smooths their normals as it does their colours: that is `normal_smoothing`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from renderer.effects import ShaderPart
from storage.packed.schema import Header

PART = ShaderPart("LIT", ("attribute",))


@dataclass(frozen=True)
class Light:
    """What colours are times: ambient + diffuse max(0, normal . towards), in linear light."""

    towards: tuple[float, float, float] = (0.0, 0.0, -1.0)  # unit, in camera axes: x right, y down, z forward
    ambient: float = 1.0
    diffuse: float = 0.0


USUAL_LAMP = (-0.4, 0.7, 1.0)  # over the viewer's left shoulder
AS_PHOTOGRAPHED = Light()  # a scene that can be lit and is not looks as without


def lamp(right: float, up: float, towards_viewer: float) -> Light:
    """A distant lamp in that direction, as bright as the photographs where a surface faces it."""
    direction = np.array([right, -up, -towards_viewer], float)
    return Light(tuple((direction / np.linalg.norm(direction)).tolist()), ambient=0.3, diffuse=0.7)


def usual_light(header: Header) -> Light:
    """How a scene looks unless a viewer says otherwise: under a lamp where its colours have no light in them."""
    return lamp(*USUAL_LAMP) if has_own_lamp(header) else AS_PHOTOGRAPHED


def has_own_lamp(header: Header) -> bool:
    """Whether colours have no light in them, as those of iso-surfaces and of scans without colours."""
    return bool(header.effects.get("relighting", {}).get("lamp"))


def may_have_strays(header: Header) -> bool:
    """Whether points were scanned; a volume's surfaces have none that lie by themselves for no reason."""
    return not has_own_lamp(header) or bool(header.effects["relighting"].get("strays"))


def is_closed(header: Header) -> bool:
    """Whether surfaces end nowhere and look outwards: who sees them from outside sees no back."""
    return bool(header.effects.get("relighting", {}).get("closed"))
