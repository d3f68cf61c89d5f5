"""Numbers of splats over quadrics as a word stream: sorted inside each batch of each chunk, so that part of their order
need not be kept.

The splats of a chunk that are of one batch may stand in any order, so they stand by their numbers. Of n numbers of
`bits` bits each the highest h = ceil(log2 n) are kept in unary: a bit vector of n + 2^h bits that has its one for splat
r at bit (high bits + r). The other bits follow, a field a splat. So n splats take n (bits - h + 1) + 2^h bits, for n
bits without: 5 a splat less of a chunk of one batch. Chunks follow each other bit by bit, and every group begins on a whole
word.

Paper: Elias, "Efficient storage and retrieval by content and address of static files", J. ACM 1974; Fano 1971.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from storage.packed.batches import CHUNKS_PER_GROUP
from storage.packed.schema import (
    CHUNK,
    LEAST_NUMBER_BITS,
    MOST_FRAME_CELLS,
    MOST_NUMBER_BITS,
    NORMAL_GRIDS,
    TURN_W,
    curve_units,
    frame_origins,
    size_cells,
    steps_of,
)

_BLOCK = 4096  # chunks whose bits are spread to bytes at a time
_LENGTHS = np.array([max(0, n - 1).bit_length() for n in range(CHUNK + 1)])
_FINITE = (0x0080, 0x7F7F)  # upper halves of float32 that are above 0, neither denormal nor infinite


def high_bits(counts: np.ndarray, bits: np.ndarray) -> np.ndarray:
    """How many bits of its numbers each batch keeps in unary, (c, b) int64: 0 where that would not be shorter."""
    n = counts.astype(np.int64)
    high = np.minimum(_LENGTHS[n], bits.astype(np.int64)[:, None] - LEAST_NUMBER_BITS)
    return np.where(n * high > n + (1 << high), high, 0)


def _lengths(counts: np.ndarray, bits: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each batch of each chunk (c, b): high bits, bits of its vector, and bits of it all."""
    n, high = counts.astype(np.int64), high_bits(counts, bits)
    vector = np.where(high > 0, n + (1 << high), 0)
    return high, vector, vector + n * (bits.astype(np.int64)[:, None] - high)


def number_starts(counts: np.ndarray, bits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the numbers of each chunk begin, (c,) int64, in bits from the first of all groups', and the words (g,) int64
    that those of each group take; of splats of each batch (c, b) and bits of a number (c,), which begin a group."""
    taken = _lengths(counts, bits)[2].sum(axis=1)
    first = np.arange(0, len(taken), CHUNKS_PER_GROUP)
    words = -(-np.add.reduceat(taken, first) // 32)
    group = np.arange(len(taken)) // CHUNKS_PER_GROUP
    before = taken.cumsum() - taken
    return before - before[first][group] + 32 * (words.cumsum() - words)[group], words


@dataclass(frozen=True)
class _Places:
    """Where what is kept of each splat stands, in bits from the stream's first word."""

    batch: np.ndarray  # (n,) its row of the batches of chunks
    rank: np.ndarray  # (n,) its place among the batch's
    low: np.ndarray  # (n,) bits of its field
    field: np.ndarray  # (n,) where that begins
    vector: np.ndarray  # (c b,) where the vector of each batch begins
    high: np.ndarray  # (c b,) bits in unary
    n: np.ndarray  # (c b,) splats


def _places(first_bit: np.ndarray, counts: np.ndarray, bits: np.ndarray) -> _Places:
    high, vector, whole = _lengths(counts, bits)
    at = first_bit[:, None] + whole.cumsum(axis=1) - whole
    n, low = counts.astype(np.int64).ravel(), (bits.astype(np.int64)[:, None] - high).ravel()
    batch = np.repeat(np.arange(len(n)), n)
    rank = np.arange(len(batch)) - np.repeat(n.cumsum() - n, n)
    field = (at + vector).ravel()[batch] + rank * low[batch]
    return _Places(batch, rank, low[batch], field, at.ravel(), high.ravel(), n)


def pack_numbers(number: np.ndarray, counts: np.ndarray, bits: np.ndarray) -> np.ndarray:
    """The words of numbers (n,) below 2^bits that ascend in each batch of each chunk, without the spare word; they begin
    a group."""
    first, words = number_starts(counts, bits)
    places = _places(first, counts, bits)
    number, stream = number.astype(np.uint64), np.zeros(32 * int(words.sum()), np.uint8)
    unary = places.high[places.batch] > 0
    top = (number >> places.low.astype(np.uint64)).astype(np.int64)
    stream[(places.vector[places.batch] + top + places.rank)[unary]] = 1
    for bit in range(int(bits.max())):
        has = places.low > bit
        stream[places.field[has] + bit] = (number[has] >> np.uint64(bit)) & np.uint64(1)
    return np.packbits(stream, bitorder="little").view("<u4").astype(np.uint32)


def unpack_numbers(words: np.ndarray, counts: np.ndarray, bits: np.ndarray) -> np.ndarray:
    """The numbers (n,) uint64 that `pack_numbers` packed to `words`, which end in a spare word.

    Raises: ValueError where a vector has not a one for each splat.
    """
    first, _ = number_starts(counts, bits)
    places = _places(first, counts, bits)
    low = places.low.astype(np.uint64)
    lowest = _field(words, places.field, np.full(len(low), LEAST_NUMBER_BITS, np.uint64))
    above = _field(words, places.field + LEAST_NUMBER_BITS, low - np.uint64(LEAST_NUMBER_BITS))
    top = _tops(words, first, places, counts.shape)
    return top << low | above << np.uint64(LEAST_NUMBER_BITS) | lowest


def _field(words: np.ndarray, first_bit: np.ndarray, width: np.ndarray) -> np.ndarray:
    """The fields (n,) uint64 of `width` (n,) bits, at most 32, that begin at the bits `first_bit` (n,)."""
    word, shift = np.minimum(first_bit >> 5, len(words) - 2), (first_bit & 31).astype(np.uint64)
    both = words[word].astype(np.uint64) | words[word + 1].astype(np.uint64) << np.uint64(32)
    return (both >> shift) & ((np.uint64(1) << width) - np.uint64(1))


def _tops(words: np.ndarray, first: np.ndarray, places: _Places, shape: tuple[int, ...]) -> np.ndarray:
    """What the vectors say, (n,) uint64."""
    top = np.zeros(len(places.batch), np.uint64)
    of_batches = places.n.cumsum()
    for start in range(0, shape[0], _BLOCK):
        rows = np.arange(start * shape[1], min(start + _BLOCK, shape[0]) * shape[1])
        rows = rows[places.high[rows] > 0]
        if not len(rows):
            continue
        begin = int(first[start]) // 32
        end = int(first[start + _BLOCK]) // 32 if start + _BLOCK < shape[0] else len(words)
        stream = np.unpackbits(words[begin:end].astype("<u4").view(np.uint8), bitorder="little")
        length = places.n[rows] + (1 << places.high[rows])
        of_vectors = length.cumsum() - length
        bit = np.arange(length.sum()) - np.repeat(of_vectors, length)
        ones = stream[np.repeat(places.vector[rows] - 32 * begin, length) + bit] > 0
        if not (np.add.reduceat(ones, of_vectors, dtype=np.int64) == places.n[rows]).all():
            raise ValueError("splats has a bit vector that has not a one for each splat of its batch")
        first_splat = of_batches[rows] - places.n[rows]
        splat = (
            np.repeat(first_splat, places.n[rows])
            + np.arange(places.n[rows].sum())
            - np.repeat(places.n[rows].cumsum() - places.n[rows], places.n[rows])
        )
        top[splat] = (bit[ones] - places.rank[splat]).astype(np.uint64)
    return top


def frame_sizes(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """How many values codes of sizes have in each chunk, (c,) uint8: the lowest digit of its numbers."""
    if "size_scale" in arrays:
        return size_cells(arrays["size_scale"])
    return np.ones(len(arrays["frame_bits"]), np.uint8)


def check_frames(arrays: dict[str, np.ndarray]) -> None:
    """ValueError unless frames are what decoders take them for, so that no number of theirs leaves 32 bits."""
    cells, bits, step = (arrays[name].astype(np.int64) for name in ("frame_cells", "frame_bits", "frame_step"))
    if cells.min() < 1 or cells.max() > MOST_FRAME_CELLS:
        raise ValueError(f"frame_cells has {cells.min()}..{cells.max()}, not 1..{MOST_FRAME_CELLS}")
    if bits.min() < LEAST_NUMBER_BITS or bits.max() > MOST_NUMBER_BITS:
        raise ValueError(f"frame_bits has {bits.min()}..{bits.max()}, not {LEAST_NUMBER_BITS}..{MOST_NUMBER_BITS}")
    normals = (arrays["normal_cells"].astype(np.int64) + 1).prod(axis=1)
    if (2**bits > normals * frame_sizes(arrays) << 32).any():
        raise ValueError("frame_bits has numbers whose cells are more than 2^32")
    if step.min() < _FINITE[0] or step.max() > _FINITE[1]:
        raise ValueError("frame_step is not the upper half of a float32 above 0")
    low = arrays["normal_low"].astype(np.int64)
    if arrays["normal_grid"].max() >= NORMAL_GRIDS:
        raise ValueError(f"normal_grid has {arrays['normal_grid'].max()}, not 0..{NORMAL_GRIDS - 1}")
    if np.abs(low).max() > 254:
        raise ValueError(f"normal_low has {low.min()}..{low.max()}, not -254..254")


def check_numbers(arrays: dict[str, np.ndarray]) -> None:
    """ValueError unless frames and numbers are what decoders take them for, so that none leaves 32 bits or an array."""
    check_frames(arrays)
    bits = arrays["frame_bits"].astype(np.int64)
    _, words = number_starts(arrays["batch_count"], bits)
    if len(arrays["splats"]) != words.sum() + 1 or not (arrays["splat_word"] == words.cumsum() - words).all():
        raise ValueError("splat_word and splats do not fit batch_count and frame_bits")
    unpack_numbers(arrays["splats"], arrays["batch_count"], bits)


def frame_boxes(arrays: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Low and high corner (c, 3) float64 against the origin of a box that holds all cells that numbers of each chunk
    can name; of frames that `check_frames` refuses, anything."""
    with np.errstate(all="ignore"):
        low, high = frame_extents(arrays, frame_sizes(arrays))
        origin = frame_origins(arrays)
        return origin + low, origin + high


def frame_extents(arrays: dict[str, np.ndarray], sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same against the frames' own origins, where codes of sizes have so many values (c,)."""
    cells = arrays["frame_cells"].astype(np.float64)
    states = cells.prod(axis=1) * (arrays["normal_cells"] + 1.0).prod(axis=1) * sizes
    squares = np.stack([cells[:, 0] ** 2, cells.prod(axis=1), cells[:, 1] ** 2], axis=1)
    rise = (np.abs(arrays["frame_curve"].astype(np.float64)) * squares).sum(axis=1) * curve_units(cells)
    ends = np.stack([cells[:, 0], cells[:, 1], 2.0 ** arrays["frame_bits"] / states + 2 * rise], axis=1)
    corners = np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)]) * ends[:, None]  # (c, 8, 3)
    corners[..., 2] -= rise[:, None]
    turn = np.concatenate([arrays["frame_turn"].astype(np.float64), np.full((len(cells), 1), TURN_W)], axis=1)
    turn = (turn / np.linalg.norm(turn, axis=1, keepdims=True))[:, None]
    axis, w = turn[..., :3], turn[..., 3:]
    turned = corners + 2 * np.cross(axis, np.cross(axis, corners) + w * corners)
    turned *= steps_of(arrays["frame_step"])[:, None, None]
    return turned.min(axis=1), turned.max(axis=1)
