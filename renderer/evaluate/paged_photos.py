"""The baseline of scenes whose photographs do not fit: splats textured from pages, in a pool of fixed size, and none
missing.

A picture is a sum over splats, so it is drawn in as many parts as the pool calls for: each fragment in the part that
has its page. The pool, its table, the feedback and the states of pages are those of flights (flight.py); nobody waits
for a frame here.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from renderer.residency.feedback import REQUIRED, Feedback
from renderer.residency.loader import PageLoader
from renderer.residency.manager import MAPPED, Manager
from renderer.splats.detail import FINEST
from renderer.splats.pages import GpuPages
from renderer.splats.renderer import Picture, Renderer
from renderer.splats.scene import GpuScene
from storage.errors import ResourceExhausted
from storage.packed.schema import NO_CAMERA, Camera
from storage.pages.file import PageFile

BUFFERS = 64  # pages that are read ahead of those that are put
READ_S = 30.0  # that a page may take
MOST_STEPS = 8  # of the manager, until what it hears is mapped: it forgets what an older part required after two


class PagedPhotos:
    """The splats of an uploaded scene with the photographs of `file`, of `cameras`, in a pool of `pool_bytes`.

    Guarantees: a picture has every page of the level that its fragments ask for, however small the pool; the same
    picture whatever the pool's size, but for the order in which a pixel's colours are added.
    Raises: ResourceExhausted for a pool that does not hold the mip tails, or a disk that does not answer;
    InvalidPackedFile for a page that was altered.
    """

    def __init__(
        self, gpu_scene: GpuScene, file: PageFile, pool_bytes: int, cameras: Sequence[Camera] | None = None
    ) -> None:
        header = gpu_scene.scene.header
        self.gpu_scene, self._file = gpu_scene, file
        label = gpu_scene.scene.arrays.get("camera", np.full(header.n_splats, NO_CAMERA, np.uint16))
        layout = file.layout
        self._pages = GpuPages(
            gpu_scene.context, layout, file.header.border_px, tuple(cameras or header.cameras), label, pool_bytes
        )
        tails = np.flatnonzero(layout.is_tail)
        self._n_pool = self._pages.shape.n_pages - len(tails)
        self._manager = Manager(layout.level_of, layout.parents, self._n_pool, self._n_pool)
        self._frame = 0
        self._loader = PageLoader(file, BUFFERS)
        self.n_parts = 0  # of the last picture
        try:
            self._put(tails)
        except BaseException:
            self.release()
            raise

    def draw(self, renderer: Renderer, view: Camera) -> Picture:
        """The baseline's picture from `view`."""
        before, self.gpu_scene.pages = self.gpu_scene.pages, self._pages
        try:
            times = renderer.times_of(view)
            self._pages.show_all(times * view.width_px, times * view.height_px)
            self._pages.take_feedback()
            renderer.render(self.gpu_scene, view, 0, detail=FINEST)
            parts = self._parts(np.flatnonzero(self._pages.take_feedback()[:, 0]))
            self.n_parts = len(parts)
            return renderer.render_by_parts(self.gpu_scene, view, lambda: self._each(parts))
        finally:
            self.gpu_scene.pages = before

    def release(self) -> None:
        self._loader.close()
        self._pages.release()

    def _parts(self, wanted: np.ndarray) -> list[np.ndarray]:
        """The pages (k,) that are sampled, cut into parts that fit the pool with the next coarser page of each."""
        layout, parts = self._file.layout, []
        start, held = 0, set[int]()
        for at, page in enumerate(wanted.tolist()):
            needed = {p for p in (page, int(layout.parents[page])) if p >= 0 and not layout.is_tail[p]}
            if len(held | needed) > self._n_pool:
                parts.append(wanted[start:at])
                start, held = at, set[int]()
            held |= needed
        return [*parts, wanted[start:]]

    def _each(self, parts: list[np.ndarray]) -> Iterator[int]:
        for number, pages in enumerate(parts):
            self._bring(pages)
            self._pages.count(pages)
            yield number

    def _bring(self, pages: np.ndarray) -> None:
        """Have `pages`, and the next coarser of each, in the pool."""
        layout = self._file.layout
        above = layout.parents[pages]
        needed = np.unique(np.concatenate([pages, above[above >= 0]]))
        needed = needed[~layout.is_tail[needed]]
        n = len(needed)
        found = Feedback(needed, np.full(n, REQUIRED, np.int8), np.ones(n), np.zeros(n, np.uint8))
        loaded = np.empty(0, np.int64)
        for _ in range(MOST_STEPS):
            self._frame += 1
            orders = self._manager.step(self._frame, found, loaded)
            for page in orders.evict.tolist():
                self._pages.drop(page)
            self._put(orders.map)
            loaded = orders.load
            if (self._manager.state[needed] == MAPPED).all():
                return
        raise AssertionError(f"{n} pages in a pool of {self._n_pool}")

    def _put(self, pages: np.ndarray) -> None:
        """Read pages, some at a time, and put them into the pool."""
        for start in range(0, len(pages), BUFFERS):
            some = pages[start : start + BUFFERS].tolist()
            for page in some:
                self._loader.request(page)
            ready = self._loader.ready(some, READ_S)
            if len(ready) < len(some):
                found = f"{len(some) - len(ready)} of {len(some)} pages not read within {READ_S:g} s"
                raise ResourceExhausted(str(self._file.path), found, "a disk that answers")
            for page in some:
                self._pages.put(page, self._loader.texels(page))
                self._loader.give_back(page)
