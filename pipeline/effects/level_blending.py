"""Blending between mip levels: two lookups an atom instead of one, for splats whose size lies between two levels.

A splat looks its atoms up in the nearer level. Textures of splats are smooth at the size of a texel, half a level finer
than a pixel: on fountain_p11 (draft) pictures with and without blending lie 55 to 58 dB from each other at 1,024 px and
48 to 51 dB at 300 px, and 0.01 to 0.02 dB apart against the photographs; the stereo pair of `make demo` takes 14 % more
of a frame. What a still picture does not show, a camera that moves slowly may, as splats change their level one by one:
that is known to who asks, not to the scan.
"""

from __future__ import annotations

from pipeline.effects.block import Sources
from pipeline.effects.effect import Effect, Measured, Worth


def _conclude(sums: list[dict], sources: Sources) -> Measured:
    return Measured(1.0, 1.0)


EFFECT = Effect(
    name="level_blending",
    title="Splats between two mip levels of their atoms mix both",
    measures="1 for every scan: all splats may lie between two levels",
    threshold=1.0,
    reason="still pictures gain next to nothing; a camera that moves is a wish, not a need of the scan",
    worth=Worth(
        "fountain_p11, draft, 4 views of 1,024, 600 and 300 px; frame time on the demo", frame_share=0.14, gain_db=0.01
    ),
    conclude=_conclude,
    by_request=True,
    needs="mip_levels",
    order=66,
)
