"""Slow twins of the packed file's decoders: one splat at a time, as docs/FORMAT.md says."""

from __future__ import annotations

import math
import struct

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.geometry.frame import tangent_frames
from storage.packed.batches import CHUNKS_PER_GROUP
from storage.packed.scene import PackedScene
from storage.packed.schema import CHUNK, CLIPLINE_BITS, FRAMES, GROUP


def read_field(words: np.ndarray, first_bit: int, width: int) -> int:
    """A field of a word stream, by way of one huge number."""
    return int.from_bytes(words.astype("<u4").tobytes(), "little") >> first_bit & (1 << width) - 1


def batch_of(scene: PackedScene, splat: int) -> int:
    """Inside a chunk the splats stand batch by batch."""
    counts = scene.arrays["batch_count"][splat // CHUNK].tolist()
    return [batch for batch, count in enumerate(counts) for _ in range(count)][splat % CHUNK]


def splats_before(scene: PackedScene, splat: int) -> list[int]:
    """Splats whose code stands before this one's in its group: lower batches, then lower splats of its own batch."""
    first = splat // GROUP * GROUP
    key = batch_of(scene, splat), splat
    members = range(first, min(first + GROUP, scene.header.n_splats))
    return [i for i in members if (batch_of(scene, i), i) < key]


def decode_code(scene: PackedScene, splat: int) -> list[tuple[int, int]]:
    """Atom and weight code of each rank."""
    header, batches = scene.header, scene.header.batches
    entry = sum(batches[batch_of(scene, i)].n_atoms for i in splats_before(scene, splat))
    first_bit = 32 * int(scene.arrays["group_word"][splat // GROUP]) if header.n_dictionary else 0
    code = []
    for rank in range(batches[batch_of(scene, splat)].n_atoms):
        field = read_field(scene.arrays["codes"], first_bit + (entry + rank) * header.entry_bits, header.entry_bits)
        code.append((field % 2**header.dictionary_bits, field >> header.dictionary_bits))
    return code


def decode_clipline(scene: PackedScene, splat: int) -> list[float] | None:
    batches = scene.header.batches
    if not batches[batch_of(scene, splat)].clipline:
        return None
    row = sum(batches[batch_of(scene, i)].clipline for i in splats_before(scene, splat))
    first_bit = 32 * int(scene.arrays["clipline_word"][splat // GROUP]) + CLIPLINE_BITS * row
    field = read_field(scene.arrays["cliplines"], first_bit, CLIPLINE_BITS)
    return [(field >> shift & 15) / 7 - 1 for shift in (0, 4, 8)]


def decode_ellipsoid(scene: PackedScene, splat: int) -> list[list[float]] | None:
    """The three half axes, by turning the tangent frame about the normal with a rotation matrix."""
    header, batches = scene.header, scene.header.batches
    if not batches[batch_of(scene, splat)].ellipsoid:
        return None
    row = sum(batches[batch_of(scene, i)].ellipsoid for i in splats_before(scene, splat))
    word = int(scene.arrays["ellipsoids"][int(scene.arrays["ellipsoid_word"][splat // GROUP]) + row])
    turn, *steps = word.to_bytes(4, "little")
    u, v, normal = (rows[0] for rows in tangent_frames(normal_code(scene, splat), header.up, header.ahead))
    rotation = Rotation.from_rotvec(np.radians(180 * turn / 256) * normal)
    radius = decode_radius(scene, splat)
    lengths = [radius * 2 ** (step / 32) / 2 ** (191 / 32) for step in steps]
    return [(length * rotation.apply(axis)).tolist() for length, axis in zip(lengths, (u, v, normal))]


def decode_radius(scene: PackedScene, splat: int) -> float:
    header, (chunk, place) = scene.header, divmod(splat, CHUNK)
    if not header.size_bits:
        return header.radius
    low, high = scene.arrays["size_scale"][chunk].tolist()
    if header.geometry == "quadrics":
        values = values_of_sizes(scene, chunk)
        code = number_of(scene, splat) % values
    else:
        values, words = 2**header.size_bits, scene.arrays["sizes"][chunk].astype("<u4").tobytes()
        code = (int.from_bytes(words, "little") >> place * header.size_bits) % values
    step = low + (high - low) * code / max(values - 1, 1)
    return header.radius * 2.0 ** (step / 16) / 2**8


def values_of_sizes(scene: PackedScene, chunk: int) -> int:
    """The lowest digit's radix of numbers of quadrics."""
    if not scene.header.size_bits:
        return 1
    low, high = scene.arrays["size_scale"][chunk].tolist()
    return min(16, 1 + math.ceil((high - low) / 1.875))


def decode_run_cell(scene: PackedScene, splat: int) -> tuple[list[float], list[int]]:
    """Position against the origin and normal code of a splat of runs, by walking its run from the start."""
    arrays, grid, chunk = scene.arrays, scene.header.runs, splat // CHUNK
    cell = splat
    if "run_batch" in arrays:
        batch = arrays["run_batch"][CHUNK * chunk : CHUNK * (chunk + 1)].tolist()
        cell = CHUNK * chunk + sorted(range(len(batch)), key=lambda i: (batch[i], i))[splat % CHUNK]
    lengths = [(int(word) >> 27) + 1 for word in arrays["run_start"]]
    run, before = 0, 0
    while before + lengths[run] <= cell:
        before, run = before + lengths[run], run + 1
    word, section = int(arrays["run_start"][run]), sum(int(first) <= run for first in arrays["run_first"]) - 1
    base = arrays["run_base"][section].tolist()
    column, row, slice_ = base[0] + word % 2048, base[1] + (word >> 11) % 2048, base[2] + (word >> 22) % 32
    a, b = arrays["run_normal"][run].tolist()
    k = 0
    for at in range(before - run, before - run + cell - before):
        code = int(arrays["run_step"][at])
        k, odd = (k + code % 8) % 6, (row + slice_) % 2
        column += {0: 1, 1: odd, 2: odd - 1, 3: -1, 4: odd - 1, 5: odd}[k]
        row += {0: 0, 1: 1, 2: 1, 3: 0, 4: -1, 5: -1}[k]
        da, db = arrays["run_codebook"][code >> 3].tolist()
        a, b = a + da, b + db
        if abs(a) > 127:
            a, b = (254 if a > 0 else -254) - a, -b
        if abs(b) > 127:
            a, b = -a, (254 if b > 0 else -254) - b
    pitch = [grid.cell / 2, grid.cell * (math.sqrt(3) / 2) / 3, grid.cell * math.sqrt(2 / 3)]
    units = [2 * column + (row + slice_) % 2, 3 * row + slice_ % 2, slice_]
    place = [float(np.float32(u) * np.float32(p)) for u, p in zip(units, pitch)]
    turn = np.array(grid.turn, np.float32).reshape(3, 3)
    products = [[np.float32(t) * np.float32(p) for t, p in zip(row, place)] for row in turn]
    return [float((x + y) + z) for x, y, z in products], [a, b]


def normal_code(scene: PackedScene, splat: int) -> np.ndarray:
    """(1, 2) int8; over quadrics (1, 3) int16"""
    if scene.header.geometry == "quadrics":
        return np.array([decode_cell(scene, splat)[1]], np.int16)
    code = decode_run_cell(scene, splat)[1] if scene.header.runs else scene.arrays["normal"][splat].tolist()
    return np.array([code], np.int8)


def decode_position(scene: PackedScene, splat: int) -> list[float]:
    """Against the origin."""
    if scene.header.runs:
        return decode_run_cell(scene, splat)[0]
    if scene.header.geometry == "quadrics":
        return decode_cell(scene, splat)[0]
    chunk = splat // CHUNK
    code = int.from_bytes(scene.arrays["position"][splat].tobytes(), "little")
    position = []
    for axis in range(3):
        bits = int(scene.arrays["box_bits"][chunk, axis])
        low, size = float(scene.arrays["box_low"][chunk, axis]), float(scene.arrays["box_size"][chunk, axis])
        position.append(low + (code % 2**bits + 0.5) * size / 2**bits)
        code >>= bits
    return position


def number_of(scene: PackedScene, splat: int) -> int:
    """The number of a splat of quadrics, its chunk's words read bit by bit."""
    arrays, (chunk, left) = scene.arrays, divmod(splat, CHUNK)
    bits, at = int(arrays["frame_bits"][chunk]), 32 * int(arrays["splat_word"][chunk // CHUNKS_PER_GROUP])
    for before in range(chunk // CHUNKS_PER_GROUP * CHUNKS_PER_GROUP, chunk):
        width = int(arrays["frame_bits"][before])
        for n in arrays["batch_count"][before].tolist():
            high = min(max(0, n - 1).bit_length(), width - 16)
            at += n * width + (n + 2**high - n * high if n * high > n + 2**high else 0)
    for n in arrays["batch_count"][chunk].tolist():
        high = min(max(0, n - 1).bit_length(), bits - 16)
        high = high if n * high > n + 2**high else 0
        length = n + 2**high if high else 0
        if left < n:
            vector = read_field(arrays["splats"], at, length)
            ones = [i for i in range(length) if vector >> i & 1]
            assert len(ones) == (n if high else 0)
            low = bits - high
            field = read_field(arrays["splats"], at + length + left * low, low)
            return ((ones[left] - left) << low) + field if high else field
        left, at = left - n, at + length + n * (bits - high)
    raise AssertionError(f"no batch has splat {splat}")


def decode_cell(scene: PackedScene, splat: int) -> tuple[list[float], list[int]]:
    """Position against the origin and octahedral normal of a splat of quadrics, its axes by a library's rotation."""
    of = {name: scene.arrays[name][splat // CHUNK].tolist() for name in FRAMES}
    number = number_of(scene, splat) // values_of_sizes(scene, splat // CHUNK)
    number, a = divmod(number, of["normal_cells"][0] + 1)
    number, b = divmod(number, of["normal_cells"][1] + 1)
    number, i = divmod(number, of["frame_cells"][0])
    k, j = divmod(number, of["frame_cells"][1])
    x, y = 2 * i + 1 - of["frame_cells"][0], 2 * j + 1 - of["frame_cells"][1]
    rise = sum(c * p for c, p in zip(of["frame_curve"], (x * x, x * y, y * y))) / 128
    rise /= 2 ** int(max(of["frame_cells"])).bit_length()
    step = struct.unpack("<f", struct.pack("<I", of["frame_step"] << 16))[0]
    along = np.array([i + 0.5, j + 0.5, k + 0.5 + rise]) * step
    box = scene.arrays["frame_box"][splat // CHUNK].astype(np.float32)
    unit = 2.0 ** (math.floor(math.log2(max(float((box[3:] - box[:3]).max()), 2.0**-100))) - 15)
    origin = box[:3].astype(float) + np.array(of["frame_origin"]) * unit
    position = origin + Rotation.from_quat([*of["frame_turn"], 117]).apply(along)
    slope = of["normal_slope"]
    p = a + of["normal_low"][0] + math.floor((slope[0] * x + slope[1] * y) / 256)
    q = b + of["normal_low"][1] + math.floor((slope[2] * x + slope[3] * y) / 256)
    q += math.floor(of["normal_lean"] * a / 64)
    s = 175 - 8 * of["normal_grid"]
    p, q = max(-2 * s, min(2 * s, p)), max(-2 * s, min(2 * s, q))
    if abs(p) > s:
        p, q = int(math.copysign(2 * s, p)) - p, -q
    if abs(q) > s:
        p, q = -p, int(math.copysign(2 * s, q)) - q
    c = s - abs(p) - abs(q)
    if c < 0:
        p, q = (s - abs(q)) * (1 if p >= 0 else -1), (s - abs(p)) * (1 if q >= 0 else -1)
    return position.tolist(), [p, q, c]


def decode_color(scene: PackedScene, splat: int) -> list[float]:
    """sRGB, 1.0 is white: bytes, or the middle of a cell on luma and two axes of chroma."""
    arrays, step, chunk = scene.arrays, scene.header.color_step, splat // CHUNK
    if not step:
        return [byte / 255 for byte in arrays["color"][splat].tolist()]
    sizes = arrays["color_size"][chunk].tolist()
    bits = [max(0, math.ceil((size - step) / 16)) for size in sizes]
    first_bit = 32 * int(arrays["color_word"][chunk]) + splat % CHUNK * sum(bits)
    code = read_field(arrays["colors"], first_bit, sum(bits))
    on_axes = []
    for axis in range(3):
        cell, code = code % 2 ** bits[axis], code >> bits[axis]
        on_axes.append(
            arrays["color_low"][chunk, axis] / 32 + (cell + 0.5) * 2 ** (sizes[axis] / 16 - 6) / 2 ** bits[axis]
        )
    on_axes = Rotation.from_quat([*arrays["color_turn"][chunk], 306]).apply(on_axes)
    luma, across, green = on_axes[0] / math.sqrt(3), on_axes[1] / math.sqrt(2), on_axes[2] / math.sqrt(6)
    color = luma + across + green, luma - 2 * green, luma - across + green
    return [min(max(channel / 255, 0.0), 1.0) for channel in color]


def decode_patch(scene: PackedScene, splat: int, size: int = 32) -> np.ndarray:
    """(size, size, 3) float64, sRGB, not yet clamped to [0, 1]."""
    arrays, finest = scene.arrays, min(size, scene.header.atom_size)
    patch = np.tile(decode_color(scene, splat), (finest, finest, 1))
    for rank, (index, weight) in enumerate(decode_code(scene, splat)):
        atom, turn = divmod(index, scene.header.n_turns)
        amount = float(arrays["weight_levels"][rank, weight]) * float(arrays["atom_scale"][atom])
        patch += amount * turned(arrays[f"atoms_{finest}"][atom].astype(np.float64), turn)
    return patch if finest == size else magnified(patch, size)


def turned(texels: np.ndarray, turn: int) -> np.ndarray:
    """Texels (s, s, 3) of an atom in a turn, one by one."""
    result, last = np.empty_like(texels), len(texels) - 1
    for row in range(last + 1):
        for column in range(last + 1):
            y, x = (column, row) if turn & 4 else (row, column)
            result[row, column] = texels[last - y if turn & 2 else y, last - x if turn & 1 else x]
    return result


def magnified(texels: np.ndarray, size: int) -> np.ndarray:
    """(size, size, 3): bilinear lookups in texels (s, s, 3), edges repeated."""
    s = len(texels)
    at = np.clip((np.arange(size) + 0.5) * s / size - 0.5, 0, s - 1)
    first = np.minimum(at.astype(int), s - 2)
    share = (at - first)[:, None, None]
    rows = texels[first] * (1 - share) + texels[first + 1] * share
    share = share[:, :, 0]
    return rows[:, first] * (1 - share) + rows[:, first + 1] * share


def every_normal() -> tuple[np.ndarray, np.ndarray]:
    """All 65,025 normal codes (m, 2) and the unit normals (m, 3) they stand for, by the paper's real-valued map."""
    grid = np.arange(-127, 128)
    code = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(-1, 2)
    x, y = code[:, 0] / 127, code[:, 1] / 127
    z = 1 - np.abs(x) - np.abs(y)
    sign_x, sign_y = np.where(x >= 0, 1, -1), np.where(y >= 0, 1, -1)
    below = z < 0
    folded_x, folded_y = (1 - np.abs(y)) * sign_x, (1 - np.abs(x)) * sign_y
    point = np.stack([np.where(below, folded_x, x), np.where(below, folded_y, y), z], axis=1)
    return code.astype(np.int8), point / np.linalg.norm(point, axis=1, keepdims=True)
