"""Points that a scan itself says were not measured, or are not wanted: which marks there are, and which are left out.

A reader marks points (`Piece.mark`), the ingest leaves out what is marked, counts it by mark and says so. A mark that is
to be kept is not set in the first place.

References: ASPRS LAS 1.4 R15, tables 8, 16 and 17; ASTM E2807-11, table 11.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

if (
    TYPE_CHECKING
):  # the command line takes names and words of marks from here, and answers before numpy could be imported
    import numpy as np

KEEP, LEAVE_OUT = "keep", "leave-out"


@dataclass(frozen=True)
class Mark:
    """One reason why a point may not be drawn; `left_out` unless asked otherwise."""

    name: str
    text: str
    left_out: bool = True
    of_choice: bool = False  # somebody set it, and where all points bear it it tells nothing


MARKS = (
    Mark("range-zero", "lie at their scanner's own origin, where nothing was hit"),
    Mark("invalid", "are marked as invalid by their scanner"),
    Mark("withheld", "are marked as withheld (deleted)", of_choice=True),
    Mark("synthetic", "are marked as synthetic (not measured)", of_choice=True),
    Mark("noise", "are classified as noise (class 7 or 18)", of_choice=True),
    Mark("no-color", "have a colour that is marked as invalid"),
    Mark("no-intensity", "have an intensity that is marked as invalid"),
    Mark("overlap", "are marked as overlap of flight lines", left_out=False, of_choice=True),
)
NUMBER = {mark.name: i + 1 for i, mark in enumerate(MARKS)}  # what Piece.mark holds; 0 is a point that is drawn
WORDS = f"NAME={KEEP}|{LEAVE_OUT}, joined by commas; NAME of {', '.join(m.name for m in MARKS)}"


def canonical_marks(text: str) -> str:
    """The one text for what is asked of marks, with only what differs from the default. Raises ValueError.

    >>> canonical_marks("overlap=leave-out, withheld=keep,noise=leave-out")
    'withheld=keep,overlap=leave-out'
    """
    asked = {}
    for part in filter(None, (p.strip() for p in text.split(","))):
        name, _, choice = (word.strip() for word in part.partition("="))
        if name not in NUMBER or choice not in (KEEP, LEAVE_OUT):
            raise ValueError(f"marked_points has {part!r}; allowed: {WORDS}")
        asked[name] = choice
    changed = [m for m in MARKS if asked.get(m.name, _usual(m)) != _usual(m)]
    return ",".join(f"{m.name}={asked[m.name]}" for m in changed)


def _usual(mark: Mark) -> str:
    return LEAVE_OUT if mark.left_out else KEEP


def left_out(text: str) -> frozenset[str]:
    """The names of the marks that are left out, of what is asked of them."""
    asked = dict(part.split("=") for part in canonical_marks(text).split(",") if part)
    return frozenset(m.name for m in MARKS if asked.get(m.name, _usual(m)) == LEAVE_OUT)


def set_marks(n: int, found: Mapping[str, np.ndarray], wanted: frozenset[str]) -> np.ndarray | None:
    """Piece.mark (n,) uint8 of those that are `wanted` among the masks `found` (n,) by name; None where there is none.

    A point with several marks has the first of the table.
    """
    import numpy as np

    mark = np.zeros(n, np.uint8)
    for name in sorted(wanted & set(found), key=NUMBER.__getitem__, reverse=True):
        mark[found[name]] = NUMBER[name]
    return mark if mark.any() else None


def tally(mark: np.ndarray | None) -> np.ndarray:
    """How many points bear each mark, (len(MARKS) + 1,) int64, those without one first; None counts as nothing."""
    import numpy as np

    return np.bincount(mark if mark is not None else np.zeros(0, np.uint8), minlength=len(MARKS) + 1)


def warnings_of(counts: np.ndarray, n_points: int) -> list[str]:
    """What is said of the points that were left out; `counts` as `tally` has them."""
    return [
        f"{n:,} of {n_points:,} points {mark.text} and are left out (keep them: --marked-points {mark.name}={KEEP})"
        for mark, n in zip(MARKS, counts[1:], strict=True)
        if n
    ]
