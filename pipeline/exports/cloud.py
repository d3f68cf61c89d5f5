"""A packed scene as plain numbers: what every export begins with."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from pipeline.geometry.ellipsoids import decode_ellipsoids
from pipeline.geometry.frame import tangent_frames
from pipeline.splats.decoded import scene_normal_codes, scene_positions, scene_radii
from pipeline.texture.colors import ColorBoxes, decode_colors
from storage.packed.packed import PackedScene
from storage.packed.schema import GROUP, MIP_SIZES

WINDOW_IN_RADII = 0.35  # sigma of the window on a patch that a splat's one colour is seen through
SIDES = {4: 2, 12: 4}  # samples on a splat's disc, and to a side of its square
BACKING_DEPTH, BACKING_RADIUS = 0.8, 0.65 / 0.55  # in radii; tried from 0.65 to 0.8 (docs/EXPORTS.md)
SAMPLE_RADIUS = {2: 0.5, 4: 0.35}  # of a sample in radii, by those to a side: neighbours are 1 and 0.5 radii apart


@dataclass(frozen=True)
class Cloud:
    """Splats, or samples of them; rows correspond."""

    position: np.ndarray  # (n, 3) float64 against `origin`, in the scan's unit
    axes: (
        np.ndarray
    )  # (n, 3, 3) float64 half axes as rows: u and v one radius long and the unit normal, or an ellipsoid's
    solid: np.ndarray  # (n,) bool: an ellipsoid, whose third axis is a length too
    color: np.ndarray  # (n, 3) float64 sRGB in [0, 1]
    splat: np.ndarray  # (n,) int64: which of the file's splats this is one of
    origin: tuple[float, float, float]

    def __len__(self) -> int:
        return len(self.position)

    @property
    def normal(self) -> np.ndarray:  # (n, 3) unit
        return self.axes[:, 2] / np.linalg.norm(self.axes[:, 2], axis=1, keepdims=True)

    @property
    def radius(self) -> np.ndarray:  # (n,) of an ellipsoid the longest half axis
        lengths = np.linalg.norm(self.axes, axis=2)
        return np.where(self.solid, lengths.max(axis=1), lengths[:, 0])


def cloud_of(scene: PackedScene, all_levels: bool = False) -> Cloud:
    """Every splat of the finest level, or of `all_levels`, in the file's order, in the colour of its patch's middle.

    The middle is the patch seen through a Gaussian window of WINDOW_IN_RADII, so atoms count in any turn alike.
    """
    header = scene.header
    normal_code = scene_normal_codes(scene)
    u, v, normal = tangent_frames(normal_code, header.up, header.ahead)
    radius = scene_radii(scene)
    axes = np.stack([u * radius[:, None], v * radius[:, None], normal], axis=1)
    splat, fields = scene.ellipsoids
    solid = np.zeros(header.n_splats, bool)
    if len(splat):
        solid[splat] = True
        axes[splat] = decode_ellipsoids(fields, normal_code[splat], header.up, header.ahead, radius[splat])
    columns = (scene_positions(scene), axes, solid, _middle_colors(scene), np.arange(header.n_splats))
    first = 0 if all_levels else header.first_finest
    return Cloud(*(column[first:] for column in columns), header.origin)  # type: ignore[arg-type, call-arg]


def samples_of(scene: PackedScene, cloud: Cloud, n_samples: int, least_contrast: float = 0.0) -> Cloud:
    """Splats of the cloud of a scene as points on a grid of their square, the `n_samples` (4 or 12) on the disc, with
    the colours that the texture has there. Splats whose samples differ from their mean by less than `least_contrast` in
    every channel stay one point, in their place."""
    side = SIDES[n_samples]
    middle = (np.arange(side) + 0.5) * 2 / side - 1
    y, x = (axis.ravel() for axis in np.meshgrid(middle, middle, indexing="ij"))
    inside = x * x + y * y < 1
    place = np.column_stack([x, y])[inside]  # (n_samples, 2)
    color = np.concatenate([patch[:, inside] for patch in _patches(scene, side)])[cloud.splat]
    parts = np.abs(color - color.mean(axis=1, keepdims=True)).max(axis=(1, 2)) >= least_contrast
    splat = np.repeat(np.arange(len(cloud)), np.where(parts, n_samples, 1))
    sample = np.arange(len(splat)) - np.searchsorted(splat, splat)
    axes, divided = cloud.axes[splat], parts[splat]
    offset = np.einsum("nk,nkc->nc", place[sample], axes[:, :2])
    axes[divided] *= np.array([SAMPLE_RADIUS[side], SAMPLE_RADIUS[side], 1.0])[:, None]
    return Cloud(
        cloud.position[splat] + np.where(divided[:, None], offset, 0.0),
        axes,
        cloud.solid[splat],
        np.where(divided[:, None], color[splat, sample], cloud.color[splat]),
        cloud.splat[splat],
        cloud.origin,
    )


def backed(cloud: Cloud, splats: Cloud) -> Cloud:
    """The cloud with one more behind each disc of `splats`, larger, for what shines through; a splat's lie together."""
    behind = splats.position - BACKING_DEPTH * splats.radius[:, None] * splats.normal
    axes = splats.axes * np.array([BACKING_RADIUS, BACKING_RADIUS, 1.0])[:, None]
    backing = Cloud(behind, axes, splats.solid, splats.color, splats.splat, splats.origin)
    disc, names = ~splats.solid, [field.name for field in fields(Cloud)][:-1]
    columns = [np.concatenate([getattr(cloud, name), getattr(backing, name)[disc]]) for name in names]
    order = np.argsort(columns[-1], kind="stable")
    return Cloud(*(column[order] for column in columns), cloud.origin)  # type: ignore[arg-type, call-arg]


def averages_of(scene: PackedScene) -> np.ndarray:
    """(n, 3) float64 sRGB in [0, 1]: what patches are without their atoms."""
    arrays, step = scene.arrays, scene.header.color_step
    if not step:
        return arrays["color"] / 255
    return decode_colors(scene.color_cells, ColorBoxes.of_arrays(arrays, step)) / 255.0


def _middle_colors(scene: PackedScene) -> np.ndarray:
    color = averages_of(scene)
    if not scene.header.n_dictionary:
        return color
    atoms = scene.arrays[f"atoms_{scene.header.atom_size}"]
    size = atoms.shape[1]
    middle = (np.arange(size) + 0.5) * 2 / size - 1
    window = np.exp(-(middle**2) / (2 * WINDOW_IN_RADII**2))
    weight = np.outer(window, window)
    seen = (
        np.einsum("kijc,ij->kc", atoms.astype(np.float64), weight / weight.sum()) * scene.arrays["atom_scale"][:, None]
    )
    for start in range(0, len(color), GROUP):
        index, amount = _codes(scene, start)
        color[start : start + GROUP] += np.einsum("nr,nrc->nc", amount, seen[index // scene.header.n_turns])
    return color.clip(0, 1)


def _patches(scene: PackedScene, side: int):
    """Patches (n, side * side, 3) of one group after the other."""
    average, header = averages_of(scene), scene.header
    if not header.n_dictionary:
        yield np.repeat(average[:, None], side * side, axis=1)
        return
    turned = _turned_atoms(scene, side)
    for start in range(0, len(average), GROUP):
        index, amount = _codes(scene, start)
        atoms = np.einsum("nr,nrpc->npc", amount, turned[index])
        yield (average[start : start + GROUP, None] + atoms).clip(0, 1)


def _turned_atoms(scene: PackedScene, side: int) -> np.ndarray:
    """Every atom in every turn, (n_indices, side * side, 3) float64, of `side` texels to a side."""
    size = min((s for s in scene.header.mip_sizes if s >= side), default=MIP_SIZES[0])
    atoms = scene.arrays[f"atoms_{size}"].astype(np.float64)
    atoms = atoms.reshape(len(atoms), side, size // side, side, size // side, 3).mean(axis=(2, 4))
    atoms *= scene.arrays["atom_scale"][:, None, None, None]
    turns = []
    for turn in range(scene.header.n_turns):
        texels = atoms[:, :, ::-1] if turn & 1 else atoms
        texels = texels[:, ::-1] if turn & 2 else texels
        turns.append(texels.swapaxes(1, 2) if turn & 4 else texels)
    return np.stack(turns, axis=1).reshape(-1, side * side, 3)


def _codes(scene: PackedScene, start: int) -> tuple[np.ndarray, np.ndarray]:
    """Atom indices and what their texels are times, without the atoms' scales, of one group: two (n, n_ranks)."""
    index, weight = scene.codes(start, start + GROUP)
    used = np.arange(index.shape[1]) < scene.n_atoms[start : start + GROUP, None]
    levels = scene.arrays["weight_levels"]
    return index, np.where(used, levels[np.arange(index.shape[1]), weight], 0.0)
