"""The 64-bit sort keys of the published system (2020, section 4.4.1, Figure 5), field by field.

loadAndMapKey, most important bits first: lastSeen 43, 1 - isPredicted 1, mipLevel 4, mipDifference 4,
15 - parentMipLevel 4, 255 - distanceToCenter 8. "Sorted in increasing order" means that pages are taken from the end:
the largest key is loaded, and mapped, first.

evictKey: lastSeen 60, mipLevel 4. Sorted in decreasing order and taken from the end: the smallest key, the page that
was seen longest ago and of those the most detailed, is evicted first.
"""

from __future__ import annotations

import numpy as np


def load_and_map_key(
    last_seen: np.ndarray, predicted: np.ndarray, level: np.ndarray, difference: np.ndarray, parent_level: np.ndarray,
    distance: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """(n,) uint64 of arrays (n,): the frame a page was last seen in, whether only by prediction, its mip level, by how
    many levels it is finer than what is resident, the mip level of its parent, and 0..255 from the picture's middle."""
    key = _field(last_seen, 43)
    for values, bits in (
        (1 - predicted.astype(np.int64), 1),
        (level, 4),
        (difference, 4),
        (15 - np.clip(parent_level, 0, 15), 4),
        (255 - distance.astype(np.int64), 8),
    ):
        key = key << np.uint64(bits) | _field(values, bits)
    return key


def evict_key(last_seen: np.ndarray, level: np.ndarray) -> np.ndarray:
    """(n,) uint64: the smallest is evicted first."""
    return _field(last_seen, 60) << np.uint64(4) | _field(level, 4)


def _field(values: np.ndarray, bits: int) -> np.ndarray:
    return np.clip(values, 0, (1 << bits) - 1).astype(np.uint64)
