"""The boxes of a scan's blocks, beside its points in chunk order: of 10 billion 29 MB, which tasks map, not parse."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np

from storage.work import arrays

BLOCK_BOX = "block_box"
RUN = 64  # blocks in a row, which chunk order keeps close to each other


def store_boxes(folder: Path, low: np.ndarray, high: np.ndarray) -> None:
    """Lowest and highest corners (n_blocks, 3) float64 of blocks, against the origin."""
    boxes = np.stack([low, high], axis=1).astype(np.float64)
    arrays.store(folder, BLOCK_BOX, boxes, boxes.shape)


def boxes_of(points: Path) -> tuple[np.ndarray, np.ndarray]:
    """The corners (n_blocks, 3) float64 of the blocks of a stage that is done, not to be written to."""
    boxes = arrays.mapped(points, BLOCK_BOX)
    return boxes[:, 0], boxes[:, 1]


def around_runs(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The corners of the boxes around RUN boxes in a row each."""
    starts = np.arange(0, len(low), RUN)
    return np.minimum.reduceat(low, starts), np.maximum.reduceat(high, starts)


@functools.lru_cache(maxsize=4)
def runs_of_boxes(points: Path) -> tuple[np.ndarray, np.ndarray]:
    """Those of a stage's blocks, kept for its next task."""
    return around_runs(*boxes_of(points))
