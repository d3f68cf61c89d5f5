"""What a frame wants: pages, why they are wanted, and how much each would add to the picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

REQUIRED, POSE, MARGIN, BIAS = range(4)  # why a page is wanted; what is seen now comes first
TIERS = ("required", "pose", "margin", "bias")
FAR = 255  # distance to the middle of the picture, of what lies at its corners or beyond


@dataclass(frozen=True)
class Feedback:
    """Wanted pages, each once. Rows correspond."""

    page: np.ndarray  # (n,) int64
    tier: np.ndarray  # (n,) int8, of REQUIRED ... BIAS, the first that wants it
    pixels: np.ndarray  # (n,) float64 that it is wanted for
    distance: np.ndarray  # (n,) uint8, of the nearest of them to the middle of the picture

    @property
    def n_pages(self) -> int:
        return len(self.page)


EMPTY = Feedback(np.empty(0, np.int64), np.empty(0, np.int8), np.empty(0), np.empty(0, np.uint8))


def merged(parts: list[Feedback]) -> Feedback:
    """One feedback of several: a page has the first tier that wants it, the pixels of that tier, the least distance.

    Guarantees: pages in increasing order; independent of the order of the parts but for pixels of equal tiers, which
    add up.
    """
    page = np.concatenate([part.page for part in parts])
    if not len(page):
        return EMPTY
    tier, pixels, distance = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("tier", "pixels", "distance")
    )
    pages, row = np.unique(page, return_inverse=True)
    first = np.full(len(pages), np.iinfo(np.int8).max, np.int8)
    np.minimum.at(first, row, tier)
    nearest = np.full(len(pages), FAR, np.uint8)
    np.minimum.at(nearest, row, distance)
    counted = np.where(tier == first[row], pixels, 0.0)
    return Feedback(pages, first, np.bincount(row, counted, len(pages)), nearest)


def with_ancestors(found: Feedback, parents: np.ndarray) -> Feedback:
    """Each page with all coarser pages that show the same, up to the tail: what trilinear filtering, and a picture that
    comes in from coarse to fine, need of it. Tails (whose parent is -1) are always there and left out."""
    parts, level = [], found
    while level.n_pages:
        keep = parents[level.page] >= 0
        level = Feedback(level.page[keep], level.tier[keep], level.pixels[keep], level.distance[keep])
        parts.append(level)
        level = Feedback(parents[level.page], level.tier, level.pixels, level.distance)
    return merged(parts) if parts else EMPTY
