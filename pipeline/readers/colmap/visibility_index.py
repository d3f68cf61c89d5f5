"""Where in `fused.ply.vis` the list of every STEP-th point begins: lists differ in length, so only a walk over all can tell.

The walk looks at one number a point, about a second a GB, once a process; readers of any run of points start from there.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator

import numpy as np

from pipeline.execution.compiled import kernel
from pipeline.readers.colmap.visibility import HEADER_BYTES, VisibilityStream

STEP = 1 << 16  # points


def visibility_from(
    path: str, n_points: int, n_cameras: int, first: int, rows: list[int]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Counts and cameras, as `VisibilityStream.take` gives them, of so many `rows` of points after another, from `first` on.

    Raises: InvalidScan for what breaks a list of theirs or before them; after the last point, for bytes that follow.
    """
    stat = os.stat(path)
    starts = _starts_of(path, n_points, n_cameras, stat.st_size, stat.st_mtime_ns)
    known = min(first // STEP, len(starts) - 1)  # fewer where a list before is broken, which the stream will meet
    with open(path, "rb") as stream:
        lists = VisibilityStream(stream, n_cameras, path, int(starts[known]), known * STEP)
        for at in range(known * STEP, first, STEP):
            lists.take(min(STEP, first - at))
        for n in rows:
            yield lists.take(n)
        if first + sum(rows) == n_points:
            lists.finish()


@functools.lru_cache(maxsize=4)
def _starts_of(path: str, n_points: int, n_cameras: int, _size: int, _changed: int) -> np.ndarray:
    """The byte at which the list of every STEP-th point begins, (m,) int64; those after a list that cannot be are left out."""
    words = np.memmap(path, "<u4", "r", offset=HEADER_BYTES, shape=((os.path.getsize(path) - HEADER_BYTES) // 4,))
    starts, n_found = _walk(words, n_points, n_cameras, STEP)
    return HEADER_BYTES + 4 * starts[:n_found]


@kernel()
def _walk(words, n_points, n_cameras, step):
    starts, word = np.zeros(-(-n_points // step), np.int64), 0
    for i in range(n_points):
        if i % step == 0:
            starts[i // step] = word
        if word >= len(words) or words[word] > n_cameras:
            return starts, i // step + 1
        word += 1 + words[word]
    return starts, len(starts)
