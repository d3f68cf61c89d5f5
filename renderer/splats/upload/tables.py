"""What is derived when a scene is loaded, and its arrays side by side, as the shaders take them: words of numpy arrays.

Derived are running counts of batches (what batch_count says, summed, so that a shader can search them), where the
streams of each group and batch begin, and the box of each group. The viewer does the same
(services/web/viewer/tables.js).
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry.ellipsoids import lengths_of
from pipeline.geometry.normals import decode_normals
from pipeline.splats.decoded import scene_bounds, scene_normal_codes, scene_radii
from storage.packed.batches import CHUNKS_PER_GROUP, group_batch_counts
from storage.packed.packed import PackedScene
from storage.packed.quadrics import number_starts
from storage.packed.schema import GROUP, LEAST_NUMBER_BITS, origin_units

FRAME_WORDS = 8  # of a chunk over a quadric
ROUNDING = 1e-5  # of a cone's cosine: so much wider, or float32 might narrow it


def splat_words(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Position, normal and, where it is in whole bytes, colour of each splat side by side, (n, 8) or (n, 5) uint8: one
    load instead of five; of quadrics of each group its first word, in what follows too, where its box begins and the unit
    of origins in it, and then the words of numbers, uint32."""
    if "splats" in arrays:
        first, box = arrays["splat_word"], arrays["frame_box"][::CHUNKS_PER_GROUP]
        place = np.column_stack([box[:, :3], origin_units(box)]).astype(np.float32).view(np.uint32)
        heads = np.column_stack([first + np.uint32(5 * len(first)), place])
        return np.concatenate([heads.ravel(), arrays["splats"]]).astype(np.uint32)
    color = [arrays["color"]] if "color" in arrays else []
    return np.concatenate([arrays["position"], arrays["normal"].view(np.uint8), *color], axis=1)


def box_words(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Low corner, size, bits along x and y, and the scale of its splats' sizes, of each chunk's box, (n_chunks, 7)
    uint32; of quadrics (n_chunks, FRAME_WORDS), as renderer/shaders/quadric.glsl reads them."""
    words = _frame_words(arrays) if "splats" in arrays else np.zeros((len(arrays["batch_count"]), 7), np.uint32)
    if "box_low" in arrays:
        _add_boxes(words, arrays)
    if "size_scale" in arrays:
        at = 4 if "splats" in arrays else 6
        words[:, at] |= arrays["size_scale"].astype(np.uint32) @ np.array([1 << 16, 1 << 24], np.uint32)
    return words


def _frame_words(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Origin in the group's box, the third with the step; turn, bits of numbers and the map of normals; curve and high
    parts of cells; low parts of cells and the scale of sizes; slopes; where normals begin, their lean and the high parts
    of the first bit and the map; steps of normals and the low part of the first bit."""
    cells, step = arrays["frame_cells"].astype(np.uint32) - 1, arrays["frame_step"].astype(np.uint32)
    low, many = (arrays["normal_low"] + 256).astype(np.uint32), arrays["normal_cells"].astype(np.uint32)
    bits = arrays["frame_bits"].astype(np.uint32) - LEAST_NUMBER_BITS
    grid, origin = arrays["normal_grid"].astype(np.uint32), arrays["frame_origin"].astype(np.uint32)
    first, _ = number_starts(arrays["batch_count"], arrays["frame_bits"])
    in_group = first - np.repeat(first[::CHUNKS_PER_GROUP], CHUNKS_PER_GROUP)[: len(first)]
    in_group, lean = in_group.astype(np.uint32), arrays["normal_lean"].view(np.uint8).astype(np.uint32)
    return np.column_stack(
        [
            origin[:, 0] | origin[:, 1] << 16,
            origin[:, 2] | step << 16,
            _bytes_word(arrays["frame_turn"], bits | (grid & 7) << 5),
            _bytes_word(arrays["frame_curve"], cells[:, 0] >> 8 | cells[:, 1] >> 8 << 4),
            cells[:, 0] & 0xFF | (cells[:, 1] & 0xFF) << 8,
            np.ascontiguousarray(arrays["normal_slope"]).view(np.uint32)[:, 0],
            low[:, 0] | low[:, 1] << 9 | lean << 18 | in_group >> 16 << 26 | grid >> 3 << 31,
            many[:, 0] | many[:, 1] << 8 | (in_group & 0xFFFF) << 16,
        ]
    )


def _bytes_word(three: np.ndarray, fourth: np.ndarray) -> np.ndarray:
    """Three bytes (c, 3) and a fourth (c,) as words (c,) uint32."""
    return np.column_stack([three.view(np.uint8), fourth.astype(np.uint8)]).view("<u4")[:, 0].astype(np.uint32)


def _add_boxes(words: np.ndarray, arrays: dict[str, np.ndarray]) -> None:
    words[:, :3] = arrays["box_low"].view(np.uint32)
    words[:, 3:6] = arrays["box_size"].view(np.uint32)
    words[:, 6] = arrays["box_bits"].astype(np.uint32) @ np.array([1, 1 << 8, 0], np.uint32)


def color_box_words(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """First word, low corner, size and turn of each chunk's box of colours, (n_chunks, 4) uint32."""
    low, size = arrays["color_low"].view(np.uint16).astype(np.uint32), arrays["color_size"].astype(np.uint32)
    turn = arrays["color_turn"].view(np.uint8).astype(np.uint32)
    return np.stack(
        [
            arrays["color_word"],
            low[:, 0] | low[:, 1] << 16,
            low[:, 2] | size[:, 0] << 16 | size[:, 1] << 24,
            size[:, 2] | turn[:, 0] << 8 | turn[:, 1] << 16 | turn[:, 2] << 24,
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
    low, high = scene_bounds(scene)
    starts = np.arange(0, len(low), CHUNKS_PER_GROUP)
    reach = longest_in_groups(scene)[:, None]
    low = np.minimum.reduceat(low, starts, axis=0) - reach
    high = np.maximum.reduceat(high, starts, axis=0) + reach
    return np.concatenate(
        [
            np.nextafter(low.astype(np.float32), np.float32(-np.inf)),
            np.nextafter(high.astype(np.float32), np.float32(np.inf)),
        ],
        axis=1,
    )


def group_cones(scene: PackedScene) -> np.ndarray:
    """Axis and cosine of the half angle of a cone that holds the normals of each group, (n_groups, 4) float32; -1 where
    it holds all, or ellipsoids, which have no back. DuoDecim (2006), section 2.6."""
    normal, starts = decode_normals(scene_normal_codes(scene)), np.arange(0, scene.header.n_splats, GROUP)
    total = np.add.reduceat(normal, starts, axis=0)
    axis = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-9)
    group = np.arange(len(normal)) // GROUP
    cosine = np.minimum.reduceat((normal * axis[group]).sum(axis=1), starts) - ROUNDING
    if "ellipsoids" in scene.arrays:
        cosine[np.unique(scene.ellipsoids[0] // GROUP)] = -1
    return np.concatenate([axis, np.maximum(cosine, -1)[:, None]], axis=1).astype(np.float32)


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


def with_spare(data: np.ndarray) -> np.ndarray:
    """Bytes in whole words, and a spare one, so that the second load of a field never leaves them."""
    return np.concatenate([data.ravel(), np.zeros(-data.size % 4 + 4, np.uint8)])
