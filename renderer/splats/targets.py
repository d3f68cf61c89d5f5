"""What a frame is drawn into: depth, sums of weighted colours, and the picture; kept while the size stays."""

from __future__ import annotations

from dataclasses import dataclass

import moderngl

from renderer.splats.context import float_depth_buffer
from storage.errors import ResourceExhausted

# Half floats have 11 bits: every layer that is added rounds the sum once more. On stacks of splats of one bright
# colour, the worst case, pictures were off by 1/255 from a weight of 20 on, by 3/255 at 100 and by 24/255 at 1,000; so
# beyond OVERDRAWN (resolve.frag.glsl) a scene is drawn once more, and from then on, with sums of 24 bits. Stacks of
# copies, whose rims alone do the same, are told when a scene is loaded (stacks.py).
NARROW, WIDE = "RGBA16F", "RGBA32F"
_TYPES = {NARROW: "f2", WIDE: "f4"}


@dataclass(frozen=True)
class Targets:
    """What the passes of a picture draw into."""

    size: tuple[int, int]  # width and height in px
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
    context: moderngl.Context, size: tuple[int, int], accumulation: str = NARROW, smooth: bool = False
) -> Targets:
    """Targets of a size in px. Raises: ResourceExhausted for one that the driver has no textures for."""
    limit = context.info["GL_MAX_TEXTURE_SIZE"]
    if max(size) > limit:
        raise ResourceExhausted("picture", f"{size[0]}x{size[1]} px", f"{limit} px to a side")
    depth = float_depth_buffer(context, size)
    sums = context.texture(size, 4, dtype=_TYPES[accumulation])
    sums.filter = moderngl.NEAREST, moderngl.NEAREST
    normals = context.texture(size, 4, dtype=_TYPES[NARROW]) if smooth else None
    attribute = context.framebuffer([sums, normals] if smooth else sums, depth)
    attribute.depth_mask = False
    return Targets(
        size=size,
        visibility=context.framebuffer(depth_attachment=depth),
        attribute=attribute,
        resolve=context.framebuffer(context.texture(size, 4)),
        sums=sums,
        accumulation=accumulation,
        normals=normals,
    )
