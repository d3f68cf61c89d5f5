"""A packed scene in GPU memory: the arrays of the packed file, byte for byte, and three small tables derived from them.

Derived at load: running counts of batches (what batch_count says, summed, so that a shader can search them), where
the streams of each group and batch begin, and the box of each group.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

import moderngl
import numpy as np

from pipeline.effects.plan.request import OFF, asked_by
from pipeline.geometry.ellipsoids import lengths_of
from pipeline.splats.decoded import scene_radii
from renderer.splats.atlas import atlas_layout, upload_atlas
from renderer.splats.detail import Detail, GroupTree, group_tree, shares_of
from renderer.splats.stacks import has_stacks
from renderer.splats.targets import NARROW, WIDE
from storage.errors import ResourceExhausted
from storage.packed.batches import CHUNKS_PER_GROUP, group_batch_counts
from storage.packed.packed import PackedScene
from storage.packed.schema import GROUP, MIP_SIZES, Camera, Header, color_bits

# Bindings of the shader storage blocks; the shaders say the same numbers.
SPLATS, BOXES, RUNNING_COUNTS, GROUPS, CODES, CLIPLINES, WEIGHTS, GROUP_BOXES, DRAWS, ELLIPSOIDS, COLORS, SHARES = (
    range(12)
)
DRAW_BYTES = 20


# --- what is uploaded, as numpy arrays -----------------------------------------------------------------------------


def splat_words(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Position, normal and, where it is in whole bytes, colour of each splat side by side, (n, 8) or (n, 5) uint8: one
    load instead of five."""
    color = [arrays["color"]] if "color" in arrays else []
    return np.concatenate([arrays["position"], arrays["normal"].view(np.uint8), *color], axis=1)


def box_words(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Low corner, size, bits along x and y, and the scale of its splats' sizes, of each chunk's box, (n_chunks, 7) uint32."""
    words = np.zeros((len(arrays["box_low"]), 7), np.uint32)
    words[:, :3] = arrays["box_low"].view(np.uint32)
    words[:, 3:6] = arrays["box_size"].view(np.uint32)
    words[:, 6] = arrays["box_bits"].astype(np.uint32) @ np.array([1, 1 << 8, 0], np.uint32)
    if "size_scale" in arrays:
        words[:, 6] |= arrays["size_scale"].astype(np.uint32) @ np.array([1 << 16, 1 << 24], np.uint32)
    return words


def color_box_words(arrays: dict[str, np.ndarray], step: int) -> np.ndarray:
    """First word, low corner, size and bits of each chunk's box of colours, (n_chunks, 4) uint32."""
    low, size = arrays["color_low"].view(np.uint16).astype(np.uint32), arrays["color_size"].astype(np.uint32)
    bits = color_bits(arrays["color_size"], step).astype(np.uint32)
    return np.stack(
        [
            arrays["color_word"],
            low[:, 0] | low[:, 1] << 16,
            low[:, 2] | size[:, 0] << 16 | size[:, 1] << 24,
            size[:, 2] | bits[:, 0] << 8 | bits[:, 1] << 16 | bits[:, 2] << 24,
        ],
        axis=1,
    )


def running_counts(batch_count: np.ndarray) -> np.ndarray:
    """(n_chunks, n_batches - 1) uint16: splats of the group, through this chunk, of the batches up to this one."""
    n_chunks, n_batches = batch_count.shape
    n_groups = -(-n_chunks // CHUNKS_PER_GROUP)
    padded = np.zeros((n_groups * CHUNKS_PER_GROUP, n_batches), np.int64)
    padded[:n_chunks] = batch_count
    through = padded.reshape(n_groups, CHUNKS_PER_GROUP, n_batches).cumsum(axis=1).cumsum(axis=2)
    return through.reshape(-1, n_batches)[:n_chunks, :-1].astype(np.uint16)


def group_table(scene: PackedScene) -> np.ndarray:
    """(n_groups, 2 + 2 n_batches) uint32: first words of both streams, then each batch's first entry and clipline; of a
    batch of ellipsoids, which has no clipline, its first word in their stream."""
    header, arrays = scene.header, scene.arrays
    counts = group_batch_counts(arrays["batch_count"])
    entries = counts * [batch.n_atoms for batch in header.batches]
    lines = counts * [batch.clipline for batch in header.batches]
    table = np.zeros((header.n_groups, 2 + 2 * len(header.batches)), np.uint32)
    table[:, 0] = arrays.get("group_word", 0)
    table[:, 1] = arrays.get("clipline_word", 0)
    table[:, 2::2] = entries.cumsum(axis=1) - entries
    table[:, 3::2] = lines.cumsum(axis=1) - lines
    if "ellipsoids" in arrays:
        some = np.array([batch.ellipsoid for batch in header.batches])
        place = (counts * some).cumsum(axis=1) - counts * some + arrays["ellipsoid_word"][:, None]
        table[:, 3::2] = np.where(some, place, table[:, 3::2])
    return table


def group_boxes(scene: PackedScene) -> np.ndarray:
    """(n_groups, 6) float32: low and high corner of each group, grown by its largest radius or longest ellipsoid's half
    axis."""
    arrays = scene.arrays
    starts = np.arange(0, len(arrays["box_low"]), CHUNKS_PER_GROUP)
    reach = longest_in_groups(scene)[:, None]
    low = np.minimum.reduceat(arrays["box_low"].astype(np.float64), starts, axis=0) - reach
    high = arrays["box_low"] + arrays["box_size"].astype(np.float64)
    high = np.maximum.reduceat(high, starts, axis=0) + reach
    return np.concatenate(
        [
            np.nextafter(low.astype(np.float32), np.float32(-np.inf)),
            np.nextafter(high.astype(np.float32), np.float32(np.inf)),
        ],
        axis=1,
    )


def longest_in_groups(scene: PackedScene) -> np.ndarray:
    """How far a splat of each group reaches from its centre, (n_groups,) float64."""
    radius = scene_radii(scene)
    reach = np.maximum.reduceat(radius, np.arange(0, scene.header.n_splats, GROUP))
    if "ellipsoids" in scene.arrays:
        splat, fields = scene.ellipsoids
        np.maximum.at(reach, splat // GROUP, lengths_of(fields, radius[splat]).max(axis=1))
    return reach


def weight_table(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Weight levels, rank by rank, then the scale of each atom, float32."""
    return np.concatenate([arrays["weight_levels"].ravel(), arrays["atom_scale"]])


def indices_of_triangles(n_splats: int) -> np.ndarray:
    """One triangle a splat; four numbers each, so that a shader has the splat and its corner by a shift and a mask."""
    return (4 * np.arange(n_splats, dtype=np.uint16)[:, None] + np.arange(3, dtype=np.uint16)).ravel()


# --- upload ----------------------------------------------------------------------------------------------------------


@dataclass
class GpuScene:
    """The buffers and the texture of one packed scene, in one context.

    `bytes_by_part` counts what they take under the names of the report's size table: geometry, codes, colors,
    dictionary. Commands and targets of a frame are not counted.
    """

    scene: PackedScene
    context: moderngl.Context
    buffers: dict[int, moderngl.Buffer] = field(default_factory=dict)
    uniforms: moderngl.Buffer | None = None
    atlas: moderngl.Texture | None = None
    bytes_by_part: dict[str, int] = field(default_factory=dict)
    accumulation: str = NARROW  # of its colours: wide where splats are copies, and once the renderer finds overdraw
    watched: bool = True  # whether the renderer looks for overdraw, and may widen: not where the job asked for 16 bits
    tree: GroupTree | None = None  # of a scene with levels
    n_chosen: int = 0  # splats of the groups that were chosen last, in view or not
    drawn: frozenset[str] = frozenset()  # effects whose shader parts its programs have

    def __post_init__(self) -> None:
        header, arrays = self.scene.header, self.scene.arrays
        self.drawn = frozenset(header.effects) - {"mip_levels", "levels"}
        self.n_chosen = header.n_splats
        if header.n_dictionary == 0 or header.coarsest_size == header.atom_size:
            self.drawn -= {"level_blending"}
        if "relighting" not in self.drawn:
            self.drawn -= {"normal_smoothing"}
        if header.n_dictionary and header.coarsest_size < header.atom_size:
            self.drawn |= {"mip_levels"}
        self.watched = asked_by(header.settings)["accumulation"] != OFF
        if "accumulation" in self.drawn or (self.watched and has_stacks(self.scene)):
            self.accumulation = WIDE
        self.bytes_by_part = dict.fromkeys(("geometry", "codes", "colors", "dictionary"), 0)
        with self.context:
            self._upload_splats(header, arrays)
            self._upload(GROUP_BOXES, "geometry", group_boxes(self.scene), "group boxes")
            self._upload(RUNNING_COUNTS, "codes", running_counts(arrays["batch_count"]), "running counts of batches")
            self._upload(GROUPS, "codes", group_table(self.scene), "group table")
            if "cliplines" in arrays:
                self._upload(CLIPLINES, "geometry", arrays["cliplines"], "cliplines")
            if "ellipsoids" in arrays:
                self._upload(ELLIPSOIDS, "geometry", arrays["ellipsoids"], "ellipsoids")
            if header.n_dictionary:
                self._upload(CODES, "codes", arrays["codes"], "codes")
                self._upload(WEIGHTS, "dictionary", weight_table(arrays), "weights")
                self.atlas, n_bytes = upload_atlas(self.context, [arrays[f"atoms_{size}"] for size in header.mip_sizes])
                self.bytes_by_part["dictionary"] += n_bytes
            if header.levels:
                self.tree = group_tree(self.scene)
                self.buffers[SHARES] = self.context.buffer(reserve=4 * header.n_groups)
            self.buffers[DRAWS] = self.context.buffer(reserve=header.n_groups * (len(header.batches) + 1) * DRAW_BYTES)
            self.uniforms = self.context.buffer(self._uniform_block())
        with_geometry = 16 * header.n_chunks if header.color_step else 3 * header.n_splats
        self.bytes_by_part["geometry"] -= with_geometry
        self.bytes_by_part["colors"] += with_geometry

    @property
    def total_bytes(self) -> int:
        return sum(self.bytes_by_part.values())

    @property
    def has_cliplines(self) -> bool:
        return CLIPLINES in self.buffers

    @property
    def has_ellipsoids(self) -> bool:
        return ELLIPSOIDS in self.buffers

    @property
    def defines(self) -> dict[str, int]:
        """What the programs that decode its splats are compiled with."""
        with_boxes, with_levels = int(COLORS in self.buffers), int(self.tree is not None)
        return {"COLOR_BOXES": with_boxes, "SIZE_BITS": self.scene.header.size_bits, "DETAIL": with_levels}

    def show(self, view: Camera, detail: Detail) -> None:
        """Choose the groups that the next passes draw of it."""
        if self.tree is not None:
            shares = shares_of(self.tree, view, self.scene.header, detail)
            with self.context:
                self.buffers[SHARES].write(shares.tobytes())
            self.n_chosen = int(self.tree.n_splats[shares > 0].sum())

    @property
    def n_leading(self) -> int:
        """How many batches come before the first one with a clipline or with ellipsoids."""
        batches = self.scene.header.batches
        return next((i for i, batch in enumerate(batches) if batch.clipline or batch.ellipsoid), len(batches))

    def bind(self) -> None:
        """Make this the scene that the next passes draw."""
        self.uniforms.bind_to_uniform_block(1)
        for binding, buffer in self.buffers.items():
            buffer.bind_to_storage_buffer(binding)
        if self.atlas is not None:
            self.atlas.use(0)

    def release(self) -> None:
        """Free the GPU memory now; the scene cannot be drawn any more."""
        for resource in (*self.buffers.values(), self.uniforms, self.atlas):
            if resource is not None:
                resource.release()
        self.buffers, self.uniforms, self.atlas = {}, None, None

    def _upload_splats(self, header: Header, arrays: dict[str, np.ndarray]) -> None:
        boxes, spare = box_words(arrays), np.zeros(1, np.uint32)
        splats = splat_words(arrays)
        if header.color_step:
            boxes = np.concatenate([boxes, color_box_words(arrays, header.color_step)], axis=1)
            splats = np.concatenate([splats.ravel(), np.zeros(-splats.size % 4, np.uint8), spare.view(np.uint8)])
            self._upload(COLORS, "colors", arrays["colors"], "colours")
        if header.size_bits:
            boxes = np.concatenate([boxes, arrays["sizes"]], axis=1)
            boxes = np.concatenate([boxes.ravel(), spare])
        self._upload(SPLATS, "geometry", splats, "position, normal and color")
        self._upload(BOXES, "geometry", boxes, "chunk boxes")

    def _upload(self, binding: int, part: str, array: np.ndarray, what: str) -> None:
        self.buffers[binding] = storage_buffer(self.context, array, what)
        self.bytes_by_part[part] += self.buffers[binding].size

    def _uniform_block(self) -> bytes:
        header = self.scene.header
        layout = atlas_layout(max(1, header.n_dictionary), header.atom_size, header.coarsest_size)
        return struct.pack(
            "4i4if7I6I2f2I",
            *header.up,
            0,
            *header.ahead,
            0,
            header.radius,
            header.n_splats,
            len(header.batches),
            header.dictionary_bits,
            header.weight_bits,
            header.n_groups,
            layout.width,
            MIP_SIZES.index(header.atom_size),
            *layout.bands,
            1 / layout.width,
            1 / layout.height,
            MIP_SIZES.index(header.coarsest_size),
            header.n_ranks,
        )


def storage_buffer(context: moderngl.Context, array: np.ndarray, what: str) -> moderngl.Buffer:
    """A shader storage buffer of an array, padded to whole words; never empty, which GL does not allow."""
    data = np.ascontiguousarray(array).tobytes()
    data += bytes(-len(data) % 4 or (0 if data else 4))
    limit = context.info["GL_MAX_SHADER_STORAGE_BLOCK_SIZE"]
    if len(data) > limit:
        raise ResourceExhausted(
            f"GPU buffer of {what}",
            f"{len(data):,} bytes",
            f"{limit:,} bytes with {context.info['GL_RENDERER']}",
            "render the scan in parts, or on a GPU with larger buffers",
        )
    return context.buffer(data)
