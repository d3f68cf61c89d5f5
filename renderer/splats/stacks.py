"""Splats that lie on one another as copies: the stacks whose 16-bit sums drift, whatever part of them a picture shows.

Half floats round a sum at every layer. Where layers differ, roundings cancel: for up to 1,000 of them a picture stays
within 1/255 of exact sums. Where they are copies every layer is rounded the same way, and the rims of 100 are off by up
to 2.4/255 though their weights sum up to no more than 3. So copies are counted once, where a scene is loaded, and not
in pictures.
"""

from __future__ import annotations

import numpy as np

from pipeline.splats.decoded import scene_positions, scene_radii
from storage.packed.packed import PackedScene
from storage.packed.schema import CHUNK, QUADRICS

# Centres within this share of a radius give a rim weights that are as good as equal: 300 rims of one colour were off by
# 6.9/255 as copies, 3.7 scattered by 1/1024 of a radius, 1.0 by 1/256 and 0.6 by 1/16.
CELL_IN_RADII = 1 / 16
# Allowed in one cell of one chunk. fountain_p11 has 6, in a chunk with an outlier and so with wide cells. The copies of
# a stack may fall into two chunks and, if they are not exact, into two cells: 41 are always found, 40 are off by
# 1.0/255.
MOST_ALIKE = 10


def has_stacks(scene: PackedScene) -> bool:
    """Whether more than MOST_ALIKE splats of a chunk lie within a cell of CELL_IN_RADII, in either of two grids half a
    cell apart.

    Guarantees: of exact copies more than twice as many are found wherever chunks part them, of near ones four times as
    many wherever cells do.
    """
    if scene.header.runs:
        return False  # a walk goes through a cell three times at most (pipeline/geometry/runs/walks.py)
    if scene.header.geometry == QUADRICS:
        return _has_stacks_of_positions(scene)
    n_chunks = len(scene.arrays["box_low"])
    code = np.full(n_chunks * CHUNK, -1)  # the last chunk is filled up with what is no splat
    code[: scene.header.n_splats] = scene.arrays["position"].astype(np.int64) @ [1, 1 << 8, 1 << 16]
    by_chunk = code.reshape(n_chunks, CHUNK)
    bits = scene.arrays["box_bits"].astype(np.int64)
    step = scene.arrays["box_size"] / np.exp2(bits)
    cell = CELL_IN_RADII * _smallest_radii(scene)[:, None]
    with np.errstate(divide="ignore"):  # a zero extent is one cell
        dropped = np.clip(np.floor(np.log2(cell / step)), 0, bits).astype(np.int64)
    suspect = _suspects(by_chunk, bits, dropped)
    return any(
        _has_many_equal(_cells(by_chunk[suspect], bits[suspect], dropped[suspect], shifted), MOST_ALIKE).any()
        for shifted in (False, True)
    )


def _has_stacks_of_positions(scene: PackedScene) -> bool:
    """The same of decoded positions, whose cells are no powers of two of a box."""
    position, n = scene_positions(scene), scene.header.n_splats
    chunk = np.arange(n) // CHUNK
    low = np.minimum.reduceat(position, np.arange(0, n, CHUNK), axis=0)
    cell = ((position - low[chunk]) / (CELL_IN_RADII * _smallest_radii(scene))[chunk, None]).clip(0, 2**20 - 2)
    for shift in (0.0, 0.5):
        key = np.full(-(-n // CHUNK) * CHUNK, -1)
        key[:n] = np.floor(cell + shift).astype(np.int64) @ np.array([1, 1 << 20, 1 << 40])
        if _has_many_equal(key.reshape(-1, CHUNK), MOST_ALIKE).any():
            return True
    return False


def _smallest_radii(scene: PackedScene) -> np.ndarray:
    """Of each chunk, (n_chunks,)."""
    radii = scene_radii(scene)
    return np.minimum.reduceat(radii, np.arange(0, len(radii), CHUNK))


def _suspects(code: np.ndarray, bits: np.ndarray, dropped: np.ndarray) -> np.ndarray:  # (n_chunks,) bool
    """Chunks that may hold a stack: of its copies in one of two grids' cells, an eighth at least share one of the
    first's."""
    kept = np.left_shift(1, bits) - np.left_shift(1, dropped)
    mask = (kept << _first_bits(bits)).sum(axis=1)
    return _has_many_equal(np.where(code < 0, code, code & mask[:, None]), MOST_ALIKE // 8)


def _cells(code: np.ndarray, bits: np.ndarray, dropped: np.ndarray, shifted: bool) -> np.ndarray:
    """The cell of each splat as one number, (n_chunks, CHUNK); of a grid shifted by half a cell where asked for."""
    cell = (code[..., None] >> _first_bits(bits)[:, None]) & (np.left_shift(1, bits) - 1)[:, None]
    if shifted:
        cell += np.left_shift(1, dropped)[:, None] >> 1
    place = _first_bits(bits) + [0, 1, 2]  # half a cell more may carry
    return np.where(code < 0, code, (cell >> dropped[:, None] << place[:, None]).sum(axis=-1))


def _first_bits(bits: np.ndarray) -> np.ndarray:
    return np.cumsum(bits, axis=1) - bits


def _has_many_equal(key: np.ndarray, most: int) -> np.ndarray:
    """Which rows hold a key, none of them negative, more than `most` times. `key` (n_chunks, CHUNK)"""
    key = np.sort(key, axis=1)
    return ((key[:, most:] == key[:, : CHUNK - most]) & (key[:, most:] >= 0)).any(axis=1)
