"""Pages on the GPU: the pool, the table that says where each page lies, and the feedback of what a frame asked for.

The pool is an array texture with pages tiled within its layers (drivers end at 2,048 layers); the table, a word a page,
is residency map and indirection in one: a shader goes from the level that it wants to coarser ones until a page is
there. No sparse textures: this runs everywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass

import moderngl
import numpy as np

from renderer.splats.context import Fence
from renderer.splats.projection import view_to_photo
from storage.errors import ResourceExhausted
from storage.packed.schema import Camera
from storage.pages.layout import PageLayout, level_size

SLOTS, GRIDS, FEEDBACK, PHOTOS, SPLAT_PHOTOS, LISTED = range(12, 18)  # bindings; the shaders say the same numbers
POOL_UNIT = 2
MOST_LISTED = 1 << 15  # pages that a frame's list has room for
RING = 3  # lists in turn: one is written, one is on its way, one is read
LATE_S = 1.0
LAYER_PX = 4096
COUNTED = np.uint32(1 << 31)  # of a page's word in the table: it is drawn in this part (pages.frag.glsl)
_INVOCATIONS = 64  # local size of flatten_feedback.comp.glsl


@dataclass(frozen=True)
class PoolShape:
    """How many pages lie in how many layers."""

    side_px: int  # of a page with its border
    columns: int
    rows: int
    layers: int

    @property
    def n_pages(self) -> int:
        return self.columns * self.rows * self.layers

    @property
    def n_bytes(self) -> int:
        return 3 * self.layers * self.columns * self.rows * self.side_px**2


def pool_shape(n_bytes: int, side_px: int, least_pages: int, layer_px: int, most_layers: int) -> PoolShape:
    """The largest pool within `n_bytes`. Raises: ResourceExhausted where that holds fewer than `least_pages`."""
    a_side = min(layer_px // side_px, max(1, int(np.sqrt(n_bytes / 3) / side_px)))
    a_layer = 3 * (a_side * side_px) ** 2
    shape = PoolShape(side_px, a_side, a_side, min(max(1, n_bytes // a_layer), most_layers))
    if shape.n_pages < least_pages or shape.n_bytes > n_bytes:
        raise ResourceExhausted(
            "page pool", f"{n_bytes:,} bytes, room for {shape.n_pages} pages of {side_px} px",
            f"room for {least_pages}: the mip tails, which are always resident, and 16 more", "a larger --pool-mib",
        )  # fmt: skip
    return shape


class GpuPages:
    """Pages of `cameras`' photographs, of one context. `label` (n_splats,) says which photograph each splat shows."""

    def __init__(
        self,
        context: moderngl.Context,
        layout: PageLayout,
        border_px: int,
        cameras: tuple[Camera, ...],
        label: np.ndarray,
        pool_bytes: int,
    ) -> None:
        self._context, self.layout, self._cameras = context, layout, cameras
        self._current: Callable[[], AbstractContextManager] = self._in_context
        side = layout.page_px + 2 * border_px
        limits = context.info["GL_MAX_TEXTURE_SIZE"], context.info["GL_MAX_ARRAY_TEXTURE_LAYERS"]
        least = int(layout.is_tail.sum()) + 16
        self.shape = pool_shape(pool_bytes, side, least, min(LAYER_PX, limits[0]), limits[1])
        self.slot_of = np.zeros(layout.n_pages, np.uint32)  # slot + 1
        self._free = list(range(self.shape.n_pages))[::-1]
        self.uniforms: dict[str, tuple[int, ...] | bool] = {
            "pool_shape": (layout.page_px, border_px, self.shape.columns, self.shape.rows)
        }
        self.show_all(1, 1)
        with self._current():
            size = self.shape.columns * side, self.shape.rows * side, self.shape.layers
            self._pool = context.texture_array(size, 3)
            self._pool.filter = moderngl.LINEAR, moderngl.LINEAR
            self._pool.repeat_x = self._pool.repeat_y = False
            words = np.append(label.astype(np.uint16), np.zeros(len(label) % 2, np.uint16))
            self._buffers = {
                SLOTS: context.buffer(self.slot_of.tobytes()),
                GRIDS: context.buffer(_grid_rows(layout).tobytes()),
                FEEDBACK: context.buffer(bytes(8 * layout.n_pages)),
                PHOTOS: context.buffer(reserve=80 * len(cameras)),
                SPLAT_PHOTOS: context.buffer(words.tobytes()),
            }
            self._lists = [context.buffer(bytes(16 * (MOST_LISTED + 1))) for _ in range(RING)]
        self._fences: list[Fence | None] = [None] * RING
        self.asks = True  # whether fragments count what they ask for
        self._frame = 0

    @contextmanager
    def drawn_by_parts(self) -> Iterator[None]:
        """While pages are put and counted between the draws of one picture, for which the context is current
        already."""
        self._current = nullcontext
        try:
            yield
        finally:
            self._current = self._in_context

    def _in_context(self) -> AbstractContextManager:
        return self._context

    @property
    def n_free(self) -> int:
        """How many pages the pool has room for beside those that are there."""
        return len(self._free)

    def show_all(self, width_px: int, height_px: int, margin_px: tuple[int, int, int, int] = (0, 0, 0, 0)) -> None:
        """What of a picture is shown: all within left, top, right and bottom margins; the rest asks for pages alone."""
        left, top, right, bottom = margin_px
        self.uniforms["inner"] = (left, top, width_px - right, height_px - bottom)

    def look(self, view: Camera) -> None:
        """Upload where the photographs lie, seen from `view`."""
        rows = np.zeros((len(self._cameras), 20), np.uint32)
        for i, camera in enumerate(self._cameras):
            rows[i, :16] = view_to_photo(view, camera).T.astype(np.float32).ravel().view(np.uint32)
            first = self.layout.first_grid[i], self.layout.levels[i]
            rows[i, 16:] = [*first, camera.width_px, camera.height_px]
        with self._current():
            self._buffers[PHOTOS].write(rows.tobytes())

    def bind(self) -> None:
        self._pool.use(POOL_UNIT)
        for binding, buffer in self._buffers.items():
            buffer.bind_to_storage_buffer(binding)

    def put(self, page: int, texels: np.ndarray) -> None:
        """A page (side, side, 3) uint8 into the pool, where there must be room."""
        slot = self._free.pop()
        a_layer, side = self.shape.columns * self.shape.rows, self.shape.side_px
        row, column = divmod(slot % a_layer, self.shape.columns)
        with self._current():
            place = (column * side, row * side, slot // a_layer, side, side, 1)
            self._pool.write(np.ascontiguousarray(texels).tobytes(), viewport=place)
        self._point(page, slot + 1)

    def drop(self, page: int) -> None:
        self._free.append(int(self.slot_of[page]) - 1)
        self._point(page, 0)

    def _point(self, page: int, entry: int) -> None:
        self.slot_of[page] = entry
        with self._current():
            self._buffers[SLOTS].write(np.uint32(entry).tobytes(), offset=4 * page)

    def count(self, pages: np.ndarray) -> None:
        """Let the next part of a picture be that of `pages` (k,), which must be there."""
        words = self.slot_of.copy()
        words[pages] |= COUNTED
        with self._current():
            self._buffers[SLOTS].write(words.tobytes())

    def take_feedback(self) -> np.ndarray:
        """As `feedback`, which is empty after it."""
        found = self.feedback()
        with self._current():
            self._buffers[FEEDBACK].clear()
        return found

    def feedback(self) -> np.ndarray:
        """(n_pages, 2) uint32 as the last frame left it: fragments in the view, in its margin; for tests."""
        with self._current():
            return np.frombuffer(self._buffers[FEEDBACK].read(), np.uint32).reshape(-1, 2).copy()

    def flatten(self, program: moderngl.ComputeShader) -> None:
        """List what the last frame asked for, and empty the feedback buffer."""
        with self._current():
            listed = self._lists[self._frame % RING]
            listed.write(bytes(16))
            listed.bind_to_storage_buffer(LISTED)
            self._buffers[FEEDBACK].bind_to_storage_buffer(FEEDBACK)
            program["n_pages"].value = self.layout.n_pages
            program.run(-(-self.layout.n_pages // _INVOCATIONS))
            self._context.memory_barrier()
            if (old := self._fences[self._frame % RING]) is not None:
                old.delete()
            self._fences[self._frame % RING] = Fence()
        self._frame += 1

    def listed(self, ago: int = 1) -> tuple[np.ndarray, int]:
        """Rows (n, 3) uint32 (page, fragments in the view, in its margin), by page, of the frame flattened last, or of
        `ago` - 1 frames before that, at most RING - 1; and how many found no room. With `ago` 2 and more a fence says
        that the GPU is done with it, so nobody waits; a list that is not there after LATE_S is none."""
        none = np.zeros((0, 3), np.uint32), 0
        if self._frame < ago:
            return none
        with self._current():
            at = (self._frame - ago) % RING
            fence, buffer = self._fences[at], self._lists[at]
            if fence is None or not fence.passed(LATE_S):
                return none
            (n,) = np.frombuffer(buffer.read(4), np.uint32)
            rows = np.frombuffer(buffer.read(16 * min(int(n), MOST_LISTED), offset=16), np.uint32)
        rows = rows.reshape(-1, 4)[:, :3]
        return rows[np.argsort(rows[:, 0])], max(0, int(n) - MOST_LISTED)

    def release(self) -> None:
        for resource in (self._pool, *self._buffers.values(), *self._lists):
            resource.release()
        with self._context:
            for fence in self._fences:
                if fence is not None:
                    fence.delete()
        self._fences = [None] * RING


def _grid_rows(layout: PageLayout) -> np.ndarray:
    """First page, columns, width and height in texels of every level of every photograph, (n_grids, 4) uint32."""
    sizes = [
        level_size(layout.sizes_px[photo][0], layout.sizes_px[photo][1], level)
        for photo, level in layout.grids[:, :2].tolist()
    ]
    return np.column_stack([layout.grids[:, 2], layout.grids[:, 3], np.array(sizes)]).astype(np.uint32)
