"""What a frame is drawn into: depth, sums of weighted colours, and the picture; kept while the size stays.

Depth and sums may be some times as large as the picture, of which each pixel is then the mean, in linear light, of those
of its parts that splats cover, and alpha their share (shaders/resolve.frag.glsl). A pixel that is drawn at one place
alone shows the splat that happens to lie there: the finest level of a far scan, whose splats are far below a pixel, is
then 25 to 33 dB from its own picture drawn four times as large (benchmarks/levels.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import moderngl
import numpy as np

from renderer.splats.context import float_depth_buffer
from storage.errors import ResourceExhausted

# Half floats have 11 bits: every layer that is added rounds the sum once more. On stacks of splats of one bright
# colour, the worst case, pictures were off by 1/255 from a weight of 20 on, by 3/255 at 100 and by 24/255 at 1,000; so
# beyond OVERDRAWN (resolve.frag.glsl) a scene is drawn once more, and from then on, with sums of 24 bits. Stacks of
# copies, whose rims alone do the same, are told when a scene is loaded (stacks.py).
NARROW, WIDE = "RGBA16F", "RGBA32F"
USUAL = 2  # times as large as pictures are drawn that are looked at and compared with photographs; a knob of `render`
MOST = 8
_HALF = 120  # of alpha: a little less, as halves are rounded either way
_SHARES, _OVERDRAWN = 0x7F, 0x80  # of alpha as resolve.frag.glsl writes it: 127 of all of a pixel, and a bit
_TYPES = {NARROW: "f2", WIDE: "f4"}


@dataclass(frozen=True)
class Picture:
    """One rendered view, top row first."""

    rgb: np.ndarray  # (height, width, 3) uint8 sRGB, black where nothing is seen
    alpha: np.ndarray  # (height, width) uint8: the share of a pixel where splats were seen, 255 all of it
    pass_seconds: dict[str, float]  # by pass, in the order they ran; waits for the GPU after each
    programs: tuple[str, ...]  # those that drew it
    accumulation: str  # what the colours were added up in: RGBA16F, or RGBA32F where overdraw called for it

    @cached_property
    def coverage(self) -> np.ndarray:
        """Where splats were seen on half of a pixel or more (height, width) bool."""
        return self.alpha >= _HALF


@dataclass(frozen=True)
class Targets:
    """What the passes of a picture draw into."""

    size: tuple[int, int]  # width and height of the picture in px
    times: int  # as large is what is drawn
    visibility: moderngl.Framebuffer  # depth alone
    attribute: moderngl.Framebuffer  # sums, tested against the same depth
    resolve: moderngl.Framebuffer  # sRGB and coverage
    sums: moderngl.Texture  # linear light times weight, weight
    accumulation: str  # format of the sums: NARROW or WIDE
    normals: moderngl.Texture | None = None  # normal times weight, weight: of scenes whose normals are smoothed

    def release(self) -> None:
        depth, picture = self.visibility.depth_attachment, self.resolve.color_attachments[0]
        for resource in (self.visibility, self.attribute, self.resolve, depth, self.sums, self.normals, picture):
            if resource is not None:
                resource.release()


def make_targets(
    context: moderngl.Context, size: tuple[int, int], accumulation: str = NARROW, smooth: bool = False, times: int = 1
) -> Targets:
    """Targets of a size in px, drawn `times` as large. Raises: ResourceExhausted for one that the driver has no
    textures for."""
    limit = context.info["GL_MAX_TEXTURE_SIZE"]
    if max(size) > limit:
        raise ResourceExhausted("picture", f"{size[0]}x{size[1]} px", f"{limit} px to a side")
    drawn = times * size[0], times * size[1]
    depth = float_depth_buffer(context, drawn)
    sums = context.texture(drawn, 4, dtype=_TYPES[accumulation])
    sums.filter = moderngl.NEAREST, moderngl.NEAREST
    normals = context.texture(drawn, 4, dtype=_TYPES[NARROW]) if smooth else None
    attribute = context.framebuffer([sums, normals] if smooth else sums, depth)
    attribute.depth_mask = False
    return Targets(
        size=size,
        times=times,
        visibility=context.framebuffer(depth_attachment=depth),
        attribute=attribute,
        resolve=context.framebuffer(context.texture(size, 4)),
        sums=sums,
        accumulation=accumulation,
        normals=normals,
    )


def read_alpha(written: np.ndarray, watched: bool) -> tuple[np.ndarray, bool]:
    """The share of each pixel that is covered, and whether any is overdrawn, of alpha as resolve.frag.glsl writes it."""
    if not watched:
        return written.copy(), False
    shares = (written & _SHARES).astype(np.uint16) * 255 // _SHARES
    return shares.astype(np.uint8), bool((written & _OVERDRAWN).any())
