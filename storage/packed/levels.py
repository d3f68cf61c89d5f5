"""How many splats the levels of a scan have: each is whole groups but the finest, and a quarter of the next or a little
fewer."""

from __future__ import annotations

from storage.limits import MOST_LEVELS as MOST_LEVELS
from storage.packed.schema import GROUP

FEWER = 4  # splats for one of the next coarser level


def n_coarser(n: int) -> int:
    """How many splats the level coarser than one of n has; 0 where that is none."""
    return n // (FEWER * GROUP) * GROUP


def are_levels(counts: tuple[int, ...]) -> bool:
    """Whether these are the splats of levels, the coarsest first."""
    return (
        1 < len(counts) <= MOST_LEVELS + 1
        and min(counts) > 0
        and all(a == n_coarser(b) for a, b in zip(counts, counts[1:]))
    )
