"""Splats over quadrics decoded on the graphics card once for all passes and corners: a window of groups after the other,
in room of a fixed size. What fits into it whole is decoded once for all frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import moderngl
import numpy as np

from storage.packed.batches import CHUNKS_PER_GROUP
from storage.packed.schema import CHUNK, GROUP, Header

SPLAT_BYTES = 16  # place from its chunk's origin as floats, a word of normal
WINDOW = 128  # groups that are decoded at a time, a million splats: 16 MiB


@dataclass
class DecodedSplats:
    """Room for the splats of a window, and which stands in it. Of the context's thread.

    What the room takes is a frame's, like its targets: it does not grow with the scene beyond `WINDOW` groups.
    """

    context: moderngl.Context
    header: Header
    buffer: moderngl.Buffer
    window: range = range(0)  # the groups that stand in the room

    def begin_frame(self) -> None:
        """What a window has of the last frame are the groups which that one drew."""
        if not self.holds_all:
            self.window = range(0)

    @property
    def holds_all(self) -> bool:
        return self.header.n_groups <= WINDOW

    def windows(self, program: moderngl.ComputeShader, is_chosen: np.ndarray | None) -> Iterator[range]:
        """Groups of the scene, window by window, each decoded where it does not stand in the room already; of a scene
        with levels those windows of which something is drawn."""
        n_groups = self.header.n_groups
        for first in range(0, n_groups, WINDOW):
            window = range(first, min(first + WINDOW, n_groups))
            if is_chosen is None or is_chosen[window.start : window.stop].any():
                if window != self.window:
                    self._decode(program, window)
                yield window

    def _decode(self, program: moderngl.ComputeShader, window: range) -> None:
        program["first_group"].value = window.start
        program["drawn_alone"].value = not self.holds_all
        n_chunks = min(len(window) * CHUNKS_PER_GROUP, -(-(self.header.n_splats - window.start * GROUP) // CHUNK))
        self.context.memory_barrier(
            moderngl.Context.SHADER_STORAGE_BARRIER_BIT
        )  # the draws' commands; and what is drawn is read
        program.run(n_chunks)
        self.context.memory_barrier(moderngl.Context.SHADER_STORAGE_BARRIER_BIT)
        self.window = window


def room_for(context: moderngl.Context, header: Header) -> DecodedSplats:
    """Inside `with context:`."""
    return DecodedSplats(context, header, context.buffer(reserve=SPLAT_BYTES * GROUP * min(header.n_groups, WINDOW)))
