"""A packed file drawn out of core: of its groups of splats only those of a pool of fixed size are in memory.

Which groups a view asks for is told by the table that the file begins with; they are read, checked by their own seals
and evicted by the rules of photographs' pages (`groups.py`). The dictionary, the maps and the coarsest level are always
there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import moderngl
import numpy as np

from renderer.effects.relighting import Light
from renderer.residency.groups import NOTHING, GroupPool
from renderer.residency.manager import LOADING
from renderer.splats.detail import Detail, in_view, shares_of, tree_of_table
from renderer.splats.projection import eye_against_origin
from renderer.splats.renderer import Picture, Renderer
from renderer.splats.scene import SHARES, GpuScene
from storage.errors import InvalidScan, ResourceExhausted
from storage.packed.groups import ragged_in
from storage.packed.layout import shape_of
from storage.packed.packed import PackedFile
from storage.packed.schema import CHUNK, GROUP, MAX_ATOMS, Camera, arrays_of

A_FRAME = 8  # groups that are asked for at a time, and that wait for a place


@dataclass
class Resident(GpuScene):
    """Groups of a file, drawn with the shares that they were given, whatever the view."""

    shares: np.ndarray | None = None  # (n_groups,) float32

    def __post_init__(self) -> None:
        super().__post_init__()
        assert self.shares is not None
        with self.context:
            self.buffers[SHARES] = self.context.buffer(reserve=4 * len(self.shares))

    @property
    def defines(self) -> dict[str, int]:
        return super().defines | {"DETAIL": 1}

    def show(self, view: Camera, detail: Detail) -> None:
        with self.context:
            self.buffers[SHARES].write(self.shares.tobytes())


class PooledFile:
    """An opened file with levels whose groups come and go in `pool_bytes`, those of the coarsest level with them.

    Guarantees: `n_bytes` never exceeds `pool_bytes`; a picture at rest is that of the whole file in memory, but where a
    view asks for more groups than the pool holds: then coarser ones, by a larger `detail`, and `detail_shown` says
    which. `prepare` is told of every scene that is made of groups, before it is drawn.

    Raises: InvalidScan for a file without levels or of runs; ResourceExhausted for a pool too small for the coarsest
    level and a group more.
    """

    def __init__(
        self,
        packed: PackedFile,
        context: moderngl.Context,
        pool_bytes: int,
        prepare: Callable[[GpuScene], None] = lambda gpu_scene: None,
    ) -> None:
        header = packed.header
        if not header.levels or header.runs:
            has = "runs" if header.runs else "one level"
            raise InvalidScan(
                str(packed.path), f"{has}, drawn through a pool", "boxes or quadrics, and levels: `--levels`"
            )
        self.packed, self.context, self.place_bytes, self._prepare = packed, context, _place_bytes(packed), prepare
        self.tree = tree_of_table(header, packed.groups)
        kept = int((self.tree.parent < 0).sum()) + A_FRAME
        self.n_pool = pool_bytes // self.place_bytes - kept
        if self.n_pool < 1:
            least = (kept + 1) * self.place_bytes
            allowed = f"at least {least:,}, for the coarsest level and {A_FRAME + 1} groups"
            raise ResourceExhausted("pool of groups", f"{pool_bytes:,} bytes", allowed, "give more")
        self._pool = GroupPool(self.tree.parent, self.n_pool, A_FRAME)
        self._of_all = packed.of_all()
        self._held = {int(g): packed.rows_of_group(int(g)) for g in self._pool.always}
        self._drawn: tuple[int, ...] = ()
        self._gpu_scene: Resident | None = None
        self.n_read = len(self._held)  # groups, again where they were evicted
        self.detail_shown = 0.0

    @property
    def n_bytes(self) -> int:
        """What the groups in memory take."""
        return sum(array.nbytes for rows in self._held.values() for array in rows.values())

    def render(
        self,
        renderer: Renderer,
        view: Camera,
        max_atoms: int = MAX_ATOMS,
        light: Light | None = None,
        detail: Detail = Detail(),
    ) -> Picture:
        """The picture at rest: once all that the view asks for has come."""
        header = self.packed.header
        seen = in_view(self.tree, view, eye_against_origin(view, header))
        asked, shares = self._fitting(view, detail, seen)
        self.detail_shown, came = asked.pixels, NOTHING
        while True:
            orders = self._pool.ask(shares, seen, came)
            wanted = self._pool.manager.state >= LOADING
            self._held = {group: rows for group, rows in self._held.items() if wanted[group]}
            if not len(orders.load) and not len(orders.map):
                break
            for group in orders.load.tolist():
                self._held[group] = self.packed.rows_of_group(group)
            self.n_read += len(orders.load)
            came = orders.load
        return renderer.render(self._scene_of(self._pool.drawn(shares, seen) * seen), view, max_atoms, light)

    def _fitting(self, view: Camera, detail: Detail, seen: np.ndarray) -> tuple[Detail, np.ndarray]:
        """The detail that is asked for, or the next coarser whose groups, with those above them, the pool holds."""
        while True:
            shares = shares_of(self.tree, view, self.packed.header, detail)
            needed = (shares > 0) & seen
            for group in np.flatnonzero(needed)[::-1]:
                while (group := self.tree.parent[group]) >= 0 and not needed[group]:
                    needed[group] = True
            if (needed & (self.tree.parent >= 0)).sum() <= self.n_pool or (shares[self.tree.parent < 0] == 1).all():
                return detail, shares
            detail = replace(detail, pixels=max(1.25 * detail.pixels, 0.25))

    def _scene_of(self, shares: np.ndarray) -> GpuScene:
        """The groups that are drawn, on the GPU; uploaded anew where they are others than last."""
        groups = tuple(np.flatnonzero(shares > 0).tolist()) or tuple(self._pool.always.tolist())
        if groups != self._drawn or self._gpu_scene is None:
            self.release()
            scene = self.packed.joined({g: self._held[g] for g in groups}, self._of_all)
            self._gpu_scene = Resident(scene, self.context, shares=shares[list(groups)])
            self._prepare(self._gpu_scene)
            self._drawn = groups
        self._gpu_scene.shares = shares[list(groups)]
        return self._gpu_scene

    def release(self) -> None:
        """Free the GPU memory now."""
        if self._gpu_scene is not None:
            self._gpu_scene.release()
        self._gpu_scene = None


def _place_bytes(packed: PackedFile) -> int:
    """What the largest group takes in memory."""
    header, n_splats = packed.header, min(GROUP, packed.header.n_splats)
    n_rows, fixed = {"n": n_splats, "c": -(-n_splats // CHUNK)}, 0
    for array in arrays_of(header):
        if array.in_groups and not array.is_ragged:
            row = int(np.prod(shape_of(header, array)[1:], dtype=np.int64)) * np.dtype(array.dtype).itemsize
            fixed += row * n_rows[array.dims[0]]
    sizes = [np.dtype(array.dtype).itemsize for array in ragged_in(header)]
    return fixed + int((packed.groups.rows.astype(np.int64) @ np.array(sizes, np.int64)).max(initial=0))
