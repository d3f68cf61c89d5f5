"""Which groups of a scene with levels are drawn in a view, and with what share: a cut through their tree.

Group j of a level stands for groups 4j to 4j + 3 of the next finer one (pipeline/splats/coarser.py), so the tree has no
table. A group is drawn where its own splats are no larger than so many pixels and its parent's are larger. Sizes and
boxes of parents hold those of their children, so a parent never looks smaller than its child, and each group is decided
for itself. About PIXELS, within a factor of FADE, a group and its children share the picture, so that nothing pops.

The size of a group is the mean by area: sizes within one differ up to sixfold, and the large ones are what is seen.
PSNR of a twentieth to the finest level's pictures (benchmarks/levels.py): 37.1, 34.5, 33.1, 32.3 dB for 35.0, 33.8,
31.4, 31.1 with means by number (fountain_p11, monstree, conference_room, pump_e57); 35.9, 32.9, 30.8, 32.0 where the
finer level comes no earlier than at PIXELS.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pipeline.splats.decoded import scene_bounds, scene_radii
from renderer.splats.projection import eye_against_origin
from storage.packed.batches import CHUNKS_PER_GROUP
from storage.packed.groups import GroupTable, mean_by_area
from storage.packed.levels import FEWER
from storage.packed.packed import PackedScene
from storage.packed.schema import GROUP, Camera, Header

FADE = 1.5  # times the pixels of a splat over which its children take its place, about those that are asked for
COMES, GONE = FADE**-0.5, FADE**0.5  # of these: until where it is alone, and from where it is not drawn
COARSER = 2**0.25  # by what the pixels of a splat grow until the budget holds
MOST_STEPS = 64  # of that: 2^16 times as many pixels


@dataclass(frozen=True)
class Detail:
    """How large splats are to look: `pixels` of their radius, as the distance of two is about one radius, where a level
    and the next finer one have about equal shares; 0 draws the finest level alone. With `most_splats` larger, until no
    more than so many are drawn."""

    pixels: float = 1.0
    most_splats: int | None = None

    def of_parts(self, times: int) -> Detail:
        """The same, told in pixels of which `times` make one."""
        return replace(self, pixels=times * self.pixels)


FINEST = Detail(0.0)


@dataclass(frozen=True)
class GroupTree:
    """The groups of all levels, the coarsest first: boxes (g, 3) each, sizes (g,), of parents with their children's in
    them."""

    low: np.ndarray
    high: np.ndarray
    size: np.ndarray
    parent: np.ndarray  # (g,) int64; -1 of the coarsest level
    n_splats: np.ndarray  # (g,)
    n_finest: int  # groups of the finest level, the last

    @cached_property
    def is_leaf(self) -> np.ndarray:
        return np.arange(len(self.parent)) >= len(self.parent) - self.n_finest


def parents_of(levels: tuple[int, ...]) -> np.ndarray:
    """The parent of each group of levels of so many splats, the coarsest first: (g,) int64, -1 of the coarsest.

    >>> parents_of((8192, 5 * 8192)).tolist()
    [-1, 0, 0, 0, 0, 0]
    """
    counts = [-(-n // GROUP) for n in levels]
    firsts = np.cumsum([0, *counts])
    parents = [np.full(counts[0], -1)]
    for above, n_above, n in zip(firsts, counts, counts[1:]):
        parents.append(above + np.minimum(np.arange(n) // FEWER, n_above - 1))
    return np.concatenate(parents)


def tree_of_table(header: Header, table: GroupTable) -> GroupTree:
    """The tree of a file with levels, by the table of groups that it begins with."""
    n_splats = np.minimum(GROUP, header.n_splats - np.arange(0, header.n_splats, GROUP))
    low, high, size = (a.astype(np.float64) for a in (table.low, table.high, table.radius[:, 0]))
    return _with_children(low, high, size, n_splats, header)


def group_tree(scene: PackedScene) -> GroupTree:
    """The tree of a scene with levels."""
    header, (chunk_low, chunk_high) = scene.header, scene_bounds(scene)
    chunks, splats = (
        np.arange(0, n, step) for n, step in ((header.n_chunks, CHUNKS_PER_GROUP), (header.n_splats, GROUP))
    )
    low = np.minimum.reduceat(chunk_low, chunks, axis=0)
    high = np.maximum.reduceat(chunk_high, chunks, axis=0)
    n_splats = np.minimum(GROUP, header.n_splats - splats)
    size = mean_by_area(scene_radii(scene), splats)
    return _with_children(low, high, size, n_splats, header)


def _with_children(
    low: np.ndarray, high: np.ndarray, size: np.ndarray, n_splats: np.ndarray, header: Header
) -> GroupTree:
    """Boxes and sizes of groups, in which those of parents come to hold those of their children."""
    parent = parents_of(header.levels)
    for group in range(len(parent) - 1, -1, -1):  # the finest come first
        if (above := parent[group]) >= 0:
            low[above], high[above] = np.minimum(low[above], low[group]), np.maximum(high[above], high[group])
            size[above] = max(size[above], size[group])
    return GroupTree(low, high, size, parent, n_splats, -(-header.n_finest // GROUP))


def shares_of(tree: GroupTree, view: Camera, header: Header, detail: Detail) -> np.ndarray:
    """The share (g,) float32 with which each group is drawn, 0 where it is not.

    Guarantees: along each path from a leaf up shares add up to 1 where a splat is at least FADE times as large as its
    children; as the eye moves they change without a jump.
    """
    eye = eye_against_origin(view, header)
    away = np.linalg.norm(np.maximum(0, np.maximum(tree.low - eye, eye - tree.high)), axis=1)
    with np.errstate(divide="ignore"):
        pixels = max(view.fx_px, view.fy_px) * tree.size / away
    wanted = detail.pixels
    shares = _shares(tree, pixels, wanted)
    if detail.most_splats is None:
        return shares
    seen = in_view(tree, view, eye)
    wanted = wanted or float(pixels[tree.is_leaf].min())
    for _ in range(MOST_STEPS):
        if tree.n_splats[seen & (shares > 0)].sum() <= detail.most_splats:
            break
        wanted *= COARSER
        shares = _shares(tree, pixels, wanted)
    return shares


def _shares(tree: GroupTree, pixels: np.ndarray, wanted: float) -> np.ndarray:
    if wanted <= 0:
        return tree.is_leaf.astype(np.float32)
    refined = np.clip((pixels / wanted - COMES) / (GONE - COMES), 0, 1)
    refined[tree.is_leaf] = 0
    above = np.where(tree.parent >= 0, refined[tree.parent], 1)
    return (above * (1 - refined)).astype(np.float32)


def in_view(tree: GroupTree, view: Camera, eye: np.ndarray) -> np.ndarray:
    """Which groups' boxes, grown by a radius, reach inside the view (g,), as cull.comp.glsl asks."""
    rotation, spare = np.array(view.rotation), 1.0
    ahead, behind = np.array([view.cx_px, view.cy_px]) + spare, np.array([view.width_px, view.height_px]) + spare
    behind = behind - [view.cx_px, view.cy_px]
    planes = [
        (0, 0, 1),
        (view.fx_px, 0, ahead[0]),
        (-view.fx_px, 0, behind[0]),
        (0, view.fy_px, ahead[1]),
        (0, -view.fy_px, behind[1]),
    ]
    low, high = tree.low - tree.size[:, None] - eye, tree.high + tree.size[:, None] - eye
    inside = np.ones(len(low), bool)
    for plane in planes:
        inward = np.array(plane) @ rotation
        inside &= (inward * np.where(inward > 0, high, low)).sum(axis=1) >= 0
    return inside
