"""Relighting: whether the renderer adds up normals beside colours, so that a viewer may light the scene."""

from __future__ import annotations

from pipeline.effects.block import Sources
from pipeline.effects.effect import Effect, Measured, Worth

UNLIT = "its colours have no light in them"  # why it is on where nobody asked


def _conclude(sums: list[dict], sources: Sources) -> Measured:
    volume = sources.scan.volume
    more = {"strays": True} if volume is None else {"closed": True} if volume.is_closed else {}
    outcome = {"lamp": True} | more if sources.scan.is_albedo else {}
    return Measured(1.0, 1.0, outcome)


EFFECT = Effect(
    name="relighting",
    title="Normals are blended too, so that the scene can be lit anew",
    measures="1 for every scan: all splats have normals",
    threshold=1.0,
    reason="photographs have their light in them; another is a wish, not a need of the scan",
    worth=Worth("fountain_p11, draft, 4 views of 1,024 px, llvmpipe", frame_share=0.04),
    conclude=_conclude,
    by_request=True,
    order=80,
)
