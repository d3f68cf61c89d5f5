"""A packed scene in GPU memory: the arrays of the packed file, byte for byte, and small tables derived from them
(upload/tables.py)."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import moderngl
import numpy as np

from pipeline.effects.plan.request import OFF, asked_by
from renderer.splats.atlas import atlas_layout, upload_atlas
from renderer.splats.detail import Detail, GroupTree, group_tree, shares_of
from renderer.splats.pages import GpuPages
from renderer.splats.stacks import has_stacks
from renderer.splats.targets import NARROW, WIDE
from renderer.splats.upload.maps import GpuMaps, MapsInView, map_frames, maps_in_view, upload_maps
from renderer.splats.upload.tables import (
    box_words,
    color_box_words,
    group_boxes,
    group_cones,
    group_table,
    running_counts,
    splat_words,
    weight_table,
    with_spare,
)
from storage.errors import ResourceExhausted
from storage.packed.packed import PackedScene
from storage.packed.schema import BOXES as IN_BOXES
from storage.packed.schema import MIP_SIZES, QUADRICS, RUNS, Camera, Header

if TYPE_CHECKING:
    from renderer.splats.upload.quadrics import DecodedSplats
    from renderer.splats.upload.runs import GpuRuns

# Bindings of the shader storage blocks; the shaders say the same numbers.
SPLATS, BOXES, RUNNING_COUNTS, GROUPS, CODES, CLIPLINES, WEIGHTS, GROUP_BOXES, DRAWS, ELLIPSOIDS, COLORS, SHARES = (
    range(12)
)
SPLAT_MAPS, MAP_FRAMES, LOOKED_UP, DECODED = 12, 13, 18, 19
DRAW_BYTES = 20


@dataclass(frozen=True)
class Look:
    """What the programs of some groups are compiled with besides, and the first row of their draws."""

    defines: dict[str, int] = field(default_factory=dict)
    first_row: int = 0


# --- upload ----------------------------------------------------------------------------------------------------------


@dataclass
class GpuScene:
    """The buffers and the texture of one packed scene, in one context.

    `bytes_by_part` counts what they take under the names of the report's size table: geometry, codes, colors,
    dictionary, maps. Commands, targets and decoded splats of a frame
    are not counted.
    """

    scene: PackedScene
    context: moderngl.Context
    buffers: dict[int, moderngl.Buffer] = field(default_factory=dict)
    uniforms: moderngl.Buffer | None = None
    atlas: moderngl.Texture | None = None
    runs: GpuRuns | None = None  # of a scene whose geometry is runs
    decoded: DecodedSplats | None = None  # of one over quadrics: what a frame decodes once
    bytes_by_part: dict[str, int] = field(default_factory=dict)
    accumulation: str = NARROW  # of its colours: wide where splats are copies, and once the renderer finds overdraw
    watched: bool = True  # whether the renderer looks for overdraw, and may widen: not where the job asked for 16 bits
    maps: GpuMaps | None = None  # of a scene that is textured from stations
    in_view: MapsInView | None = None  # of such a scene
    looks_up: bool = True  # whether the next passes look splats up in them: of those groups that LOOKED_UP names
    tree: GroupTree | None = None  # of a scene with levels
    pages: GpuPages | None = None  # of its photographs, where they are drawn
    is_chosen: np.ndarray | None = (
        None  # (n_groups,) bool, of a scene with levels: groups that were chosen last, in view or not
    )
    n_chosen: int = 0  # splats of the groups that were chosen last, in view or not
    front_only: bool = False  # discs that show their backs are left out, as of closed surfaces nobody sees them
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
        self.bytes_by_part = dict.fromkeys(("geometry", "codes", "colors", "dictionary", "maps"), 0)
        with self.context:
            self._upload_splats(header, arrays)
            cones = [group_cones(self.scene)] if self.front_only else []
            self._upload(
                GROUP_BOXES, "geometry", np.concatenate([group_boxes(self.scene), *cones], axis=1), "group boxes"
            )
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
            if header.maps:
                self._upload(SPLAT_MAPS, "maps", arrays["station"], "maps of splats")
                self._upload(MAP_FRAMES, "maps", map_frames(header), "frames of maps")
                self.maps, self.in_view = upload_maps(self.context, self.scene), maps_in_view(self.scene)
                self.bytes_by_part["maps"] += self.maps.n_bytes
                self.buffers[LOOKED_UP] = self.context.buffer(np.ones(header.n_groups, np.uint32))
            if header.levels:
                self.tree = group_tree(self.scene)
                self.buffers[SHARES] = self.context.buffer(reserve=4 * header.n_groups)
            n_draws = header.n_groups * (len(header.batches) + 1) * (2 if header.maps else 1)
            self.buffers[DRAWS] = self.context.buffer(reserve=n_draws * DRAW_BYTES)
            self.uniforms = self.context.buffer(self._uniform_block())
        with_geometry = (
            16 * header.n_chunks if header.color_step else 0 if header.geometry != IN_BOXES else 3 * header.n_splats
        )
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
        header, with_levels = self.scene.header, int(self.tree is not None)
        of_boxes = {"COLOR_BOXES": header.color_step, "DETAIL": with_levels}
        forms = {"RUNS": int(header.geometry == RUNS), "QUADRICS": int(header.geometry == QUADRICS)}
        sources = {**forms, "FRONT": int(self.front_only)}
        return {**of_boxes, "SIZE_BITS": header.size_bits, **sources}

    @property
    def looks(self) -> tuple[Look, ...]:
        """What splats are drawn by programs of their own, one after the other: groups of which none is looked up in
        maps; of others the splats that are not, those at coarser levels, those at the finest, and those whose fragments
        move there. Processors that draw run all of a shader's branches, so each has what its splats need."""
        if not self.scene.header.maps:
            return (Look(),)
        plain = {"CLIPLINE": 0}  # of maps: these trim what is looked up, and nothing that is small
        if not self.looks_up:
            return (Look(plain),)
        kinds = ({"UNMAPPED": 1, **plain}, *({"MAPPED": 1, "LOOKED_UP": kind} for kind in (1, 2, 3)))
        return Look(plain), *(Look(kind, len(self.scene.header.batches) + 1) for kind in kinds)

    def show(self, view: Camera, detail: Detail) -> None:
        """Choose the groups that the next passes draw of it, and whether they look any splat up in its map."""
        if self.in_view is not None:
            looked_up = self.in_view.looked_up(view, self.scene.header.origin)
            self.looks_up = bool(looked_up.any())
            with self.context:
                self.buffers[LOOKED_UP].write(looked_up.astype(np.uint32))
        if self.tree is not None:
            shares = shares_of(self.tree, view, self.scene.header, detail)
            with self.context:
                self.buffers[SHARES].write(shares.tobytes())
            self.is_chosen = shares > 0
            self.n_chosen = int(self.tree.n_splats[self.is_chosen].sum())

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
        if self.decoded is not None:
            self.decoded.begin_frame()
        if self.atlas is not None:
            self.atlas.use(0)
        if self.maps is not None:
            self.maps.use()
        if self.pages is not None:
            self.pages.bind()

    def release(self) -> None:
        """Free the GPU memory now; the scene cannot be drawn any more."""
        for resource in (*self.buffers.values(), self.uniforms, self.atlas, self.runs, self.maps):
            if resource is not None:
                resource.release()
        self.buffers, self.uniforms, self.atlas, self.runs, self.decoded, self.maps = {}, None, None, None, None, None

    def _upload_splats(self, header: Header, arrays: dict[str, np.ndarray]) -> None:
        boxes, spare = box_words(arrays), np.zeros(1, np.uint32)
        if header.color_step:
            boxes = np.concatenate([boxes, color_box_words(arrays)], axis=1)
            self._upload(COLORS, "colors", arrays["colors"], "colours")
        elif header.geometry != IN_BOXES:
            self._upload(COLORS, "colors", with_spare(arrays["color"]), "colours")
        if "sizes" in arrays:
            boxes = np.concatenate([boxes, arrays["sizes"]], axis=1)
            boxes = np.concatenate([boxes.ravel(), spare])
        if header.runs:
            self._decode_runs()
        else:
            splats = splat_words(arrays)
            boxed = header.color_step and header.geometry == IN_BOXES
            self._upload(SPLATS, "geometry", with_spare(splats) if boxed else splats, "geometry")
        if header.geometry == QUADRICS:
            from renderer.splats.upload.quadrics import room_for  # for quadrics alone

            self.decoded = room_for(self.context, header)
            self.buffers[DECODED] = self.decoded.buffer
        self._upload(BOXES, "geometry", boxes, "chunk boxes")

    def _decode_runs(self) -> None:
        """Positions and normals for the passes; what they take decoded is not counted, for the card can decode them
        again."""
        from renderer.splats.upload.runs import upload_runs  # for runs alone

        self.runs = upload_runs(self.context, self.scene)
        self.runs.decode()
        self.context.memory_barrier(moderngl.Context.SHADER_STORAGE_BARRIER_BIT)
        self.buffers[SPLATS] = self.runs.splats
        self.bytes_by_part["geometry"] += self.runs.coded_bytes

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
