"""Which surfaces of a volume are asked for, and how: iso values with a colour each, size of cells, how values are found."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pipeline.volumes.volume import Choice

# Colours without light in them, as a lamp finds them: bone, skin, and three that are told from these and from each other.
PALETTE = ((224, 208, 178), (206, 138, 112), (104, 158, 178), (146, 170, 96), (168, 130, 176))
OPEN, CLOSED = BORDERS = ("open", "closed")


@dataclass(frozen=True)
class Iso:
    """A surface: where values pass `value`, drawn in a colour."""

    value: float
    color: tuple[int, int, int]

    def text(self) -> str:
        return f"{self.value!r}=#{bytes(self.color).hex()}"


@dataclass(frozen=True)
class SurfaceRequest:
    """What a job says of a volume. No iso values: the one that the histogram proposes first."""

    isos: tuple[Iso, ...] = ()
    cell: float | None = None  # distance of neighbouring cells, unit; None: a cell a voxel
    method: str = "trilinear"
    border: str = OPEN
    choice: Choice = Choice()


def parse_isos(text: str) -> tuple[Iso, ...]:
    """Iso values of one text, each perhaps with a colour; without one they take those of the palette in turn.

    Raises: ValueError naming the part and what is allowed.

    >>> parse_isos("60, 130=#ffffff")
    (Iso(value=60.0, color=(224, 208, 178)), Iso(value=130.0, color=(255, 255, 255)))
    """
    isos: list[Iso] = []
    for part in (part.strip() for part in text.split(",")):
        if not part:
            continue
        value, _, color = (piece.strip() for piece in part.partition("="))
        try:
            number = float(value)
            rgb = bytes.fromhex(color.removeprefix("#")) if color else bytes(PALETTE[len(isos) % len(PALETTE)])
        except ValueError:
            number, rgb = math.nan, b""
        if not math.isfinite(number) or len(rgb) != 3:
            raise ValueError(f"iso {part!r}; allowed: VALUE or VALUE=#RRGGBB, joined by commas")
        if any(number == iso.value for iso in isos):
            raise ValueError(f"iso {number:g} occurs twice; allowed: every value once")
        isos.append(Iso(number, tuple(rgb)))  # type: ignore[arg-type]
    return tuple(isos)


def canonical_isos(text: str) -> str:
    """The one text of such a list.

    >>> canonical_isos("60 ,130=FFFFFF")
    '60.0=#e0d0b2,130.0=#ffffff'
    """
    return ",".join(iso.text() for iso in parse_isos(text))


def parse_spacing(text: str) -> tuple[float, float, float] | None:
    """Three lengths, or None of an empty text. Raises ValueError.

    >>> parse_spacing("0.5,0.5,2")
    (0.5, 0.5, 2.0)
    """
    if not text.strip():
        return None
    try:
        i, j, k = (float(part) for part in text.split(","))
    except ValueError:
        i = j = k = 0.0
    if not all(0 < x < math.inf for x in (i, j, k)):
        raise ValueError(f"spacing {text!r}; allowed: I,J,K, three lengths above 0")
    return i, j, k


def canonical_spacing(text: str) -> str:
    """The one text of a spacing."""
    found = parse_spacing(text)
    return ",".join(map(repr, found)) if found else ""
