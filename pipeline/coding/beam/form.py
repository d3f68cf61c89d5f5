"""How atoms are chosen, as one word: `omp`, `ormp`, or the beam `WxC`."""

from __future__ import annotations

import re
from dataclasses import dataclass

MOST_WIDTH = MOST_CANDIDATES = 16
WORDS = f"omp, ormp, or a beam WxC as 2x2: 1 to {MOST_WIDTH} supports, each tried with 1 to {MOST_CANDIDATES} atoms"


@dataclass(frozen=True)
class Beam:
    """`width` supports are followed, each is tried with `candidates` atoms; 1x1 is order-recursive pursuit alone."""

    width: int
    candidates: int

    def __str__(self) -> str:
        return "ormp" if self == Beam(1, 1) else f"{self.width}x{self.candidates}"


def beam_of(pursuit: str) -> Beam | None:
    """The beam that a word stands for, None for plain OMP. Raises ValueError saying what is allowed.

    >>> beam_of("2x4"), beam_of("ormp"), beam_of("omp")
    (Beam(width=2, candidates=4), Beam(width=1, candidates=1), None)
    """
    if pursuit == "omp":
        return None
    sizes = re.fullmatch(r"([0-9]{1,2})x([0-9]{1,2})", "1x1" if pursuit == "ormp" else str(pursuit))
    if sizes:
        width, candidates = map(int, sizes.groups())
        if 1 <= width <= MOST_WIDTH and 1 <= candidates <= MOST_CANDIDATES:
            return Beam(width, candidates)
    raise ValueError(f"pursuit is {pursuit!r}; allowed: {WORDS}")


def canonical_pursuit(text: str) -> str:
    """The one word for what it asks. Raises ValueError."""
    return str(beam_of(text) or "omp")
