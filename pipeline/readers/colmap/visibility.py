"""`fused.ply.vis`: for each fused point, the cameras that saw it, read in step with the points.

u64 number of points, then per point u32 n and n x u32 position in the list of registered images, little-endian.

References: src/colmap/mvs/fusion.cc, WritePointsVisibility; colmap#2040 (positions, not image ids).
"""

from __future__ import annotations

import struct
from typing import BinaryIO

import numpy as np

from pipeline.execution.compiled import kernel
from storage.errors import InvalidScan

HEADER_BYTES = 8
_BLOCK_BYTES = 1 << 20


def check_visibility(stream: BinaryIO, n_bytes: int, n_points: int, where: str) -> None:
    """Checks the header against the number of points and the length of the file.

    Raises: InvalidScan naming both numbers.
    """
    header = stream.read(HEADER_BYTES)
    if len(header) < HEADER_BYTES:
        raise InvalidScan(where, f"{n_bytes} bytes", f"at least {HEADER_BYTES}", "the file may be truncated")
    (n_listed,) = struct.unpack("<Q", header)
    if n_listed != n_points:
        raise InvalidScan(f"{where}:count", f"{n_listed} points", f"{n_points}, as many as fused.ply has")
    needed = HEADER_BYTES + 4 * n_points
    if n_bytes < needed or n_bytes % 4:
        allowed = f"{needed} or more and a multiple of 4"
        raise InvalidScan(where, f"{n_bytes} bytes for {n_points} points", allowed, "the file may be truncated")


class VisibilityStream:
    """Hands out the lists of the next n points, holding one block of the file at a time; the list of point `n_taken` is at byte
    `offset`."""

    def __init__(
        self, stream: BinaryIO, n_cameras: int, where: str, offset: int = HEADER_BYTES, n_taken: int = 0
    ) -> None:
        self.stream, self.n_cameras, self.where = stream, n_cameras, where
        self.words = np.empty(0, "<u4")  # the block, with what was left of the one before
        self.next = 0  # word at which the next point's list begins
        self.block_offset = offset  # of words[0] in the file
        self.n_taken = n_taken
        stream.seek(offset)

    @property
    def offset(self) -> int:
        return self.block_offset + 4 * self.next

    def take(self, n_points: int) -> tuple[np.ndarray, np.ndarray]:
        """Counts `(n_points,)` int64 and camera positions `(sum of counts,)` int32 of the next points.

        Raises: InvalidScan naming the point and the value, or the byte where the file ends.
        """
        counts, cameras = [np.empty(0, np.int64)], [np.empty(0, np.int32)]
        while n_points:
            count, camera, end = self._whole_lists(n_points)
            if len(count):
                counts.append(count)
                cameras.append(camera)
                self.next = end
                n_points -= len(count)
                self.n_taken += len(count)
            else:
                self._fill()
        return np.concatenate(counts), np.concatenate(cameras)

    def finish(self) -> None:
        """Raises InvalidScan where bytes follow the last point's list."""
        if self.next < len(self.words) or self.stream.read(1):
            raise InvalidScan(self.where, f"bytes after the last list, at byte {self.offset}", "no trailing bytes")

    def _fill(self) -> None:
        block = self.stream.read(_BLOCK_BYTES)
        if len(block) < 4:
            end = self.block_offset + 4 * len(self.words) + len(block)
            found = f"the file ends at byte {end}, within the list of point {self.n_taken}"
            raise InvalidScan(self.where, found, "a whole file", "the file may be truncated")
        self.block_offset, left = self.offset, self.words[self.next :]
        self.words = np.concatenate([left, np.frombuffer(block[: len(block) // 4 * 4], "<u4")])
        self.next = 0

    def _whole_lists(self, max_points: int) -> tuple[np.ndarray, np.ndarray, int]:
        """Counts and cameras of lists that lie wholly in the block, and where the last of them ends."""
        counts, cameras, end, is_wrong = _lists(self.words, self.next, max_points, self.n_cameras)
        where = f"{self.where}:point {self.n_taken + len(counts)}"
        if is_wrong:
            allowed = f"0 to {self.n_cameras - 1}, positions in the list of registered images"
            raise InvalidScan(where, f"camera {self.words[end]}", allowed)
        if end < len(self.words) and len(counts) < max_points and self.words[end] > self.n_cameras:
            raise InvalidScan(where, f"{self.words[end]} cameras", f"at most {self.n_cameras}")
        return counts, cameras, end


@kernel()
def _lists(words, word, most, n_cameras):
    """Counts (n,) and cameras of the next lists, at most so many, and where the last of them ends: before one that is cut off or
    too long; or at a camera that there is none of, and True."""
    counts = np.empty(min(most, words.shape[0] - word), np.int64)
    cameras = np.empty(words.shape[0] - word, np.int32)
    n, m = 0, 0
    while n < len(counts) and word < words.shape[0]:
        count = np.int64(words[word])
        if count > n_cameras or word + count >= words.shape[0]:
            break
        for at in range(word + 1, word + 1 + count):
            if words[at] >= n_cameras:
                return counts[:n], cameras[:m], at, True
            cameras[m] = words[at]
            m += 1
        counts[n] = count
        n += 1
        word += count + 1
    return counts[:n], cameras[:m], word, False
