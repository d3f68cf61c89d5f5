"""What a frame is drawn into: depth, sums of weighted colours, and the picture; kept while the size stays."""

from __future__ import annotations

from dataclasses import dataclass

import moderngl

from renderer.context import float_depth_buffer
from storage.errors import ResourceExhausted


@dataclass(frozen=True)
class Targets:
    size: tuple[int, int]  # width and height in px
    visibility: moderngl.Framebuffer  # depth alone
    attribute: moderngl.Framebuffer  # sums, tested against the same depth
    resolve: moderngl.Framebuffer  # sRGB and coverage
    sums: moderngl.Texture  # RGBA16F: linear light times weight, weight

    def release(self) -> None:
        depth, picture = self.visibility.depth_attachment, self.resolve.color_attachments[0]
        for resource in (self.visibility, self.attribute, self.resolve, depth, self.sums, picture):
            resource.release()


def make_targets(context: moderngl.Context, size: tuple[int, int]) -> Targets:
    limit = context.info["GL_MAX_TEXTURE_SIZE"]
    if max(size) > limit:
        raise ResourceExhausted("picture", f"{size[0]}x{size[1]} px", f"{limit} px to a side")
    depth = float_depth_buffer(context, size)
    sums = context.texture(size, 4, dtype="f2")
    sums.filter = moderngl.NEAREST, moderngl.NEAREST
    attribute = context.framebuffer(sums, depth)
    attribute.depth_mask = False
    return Targets(
        size=size,
        visibility=context.framebuffer(depth_attachment=depth),
        attribute=attribute,
        resolve=context.framebuffer(context.texture(size, 4)),
        sums=sums,
    )
