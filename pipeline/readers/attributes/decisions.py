"""What a scan's colours and intensities are taken for, told from samples and checked against all points.

A reader samples when it opens a scan, decides, and goes on gathering evidence while the points are read (`Piece.look`).
Where all points say otherwise than the sample did, they are read again as the scan is then (`ScanSource.settle`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.readers.attributes.looks import Look
from pipeline.readers.attributes.marks import MARKS
from pipeline.readers.attributes.ranges import range_of

WHOLE = 1 << 18  # scans of so many points or fewer are looked at as a whole when they are opened
N_PROBES = 8
PROBE_POINTS = 2048


_NAMES = {255.0: "8-bit values, ", 1023.0: "10-bit values, ", 4095.0: "12-bit values, ", 16383.0: "14-bit values, "}


def probe_starts(n_points: int) -> list[tuple[int, int]]:
    """Runs (start, n) that are looked at: all points of a small scan, else one run somewhere in each of N_PROBES parts."""
    if n_points <= WHOLE:
        return [(0, n_points)]
    part = n_points // N_PROBES
    shift = np.random.default_rng(n_points).integers(0, part - PROBE_POINTS, N_PROBES)
    return [(i * part + int(shift[i]), PROBE_POINTS) for i in range(N_PROBES)]


@dataclass(frozen=True)
class Decision:
    """How a scan's attributes are used."""

    top: float | None = None  # the colour value that is white; None: colours are not used
    intensity: bool = False
    ignored: frozenset[str] = frozenset()  # marks that all points bear, which then tell nothing


def decide(look: Look, has_color: bool, is_float: bool, usual_top: float, has_intensity: bool) -> Decision:
    """From what was seen, of a scan that has these attributes."""
    color, intensity = look.color, look.intensity
    uses_color = has_color and not color.is_zero and not (color.is_constant and color.is_grey)
    return Decision(
        top=range_of(color, is_float, usual_top).top if uses_color else None,
        intensity=has_intensity and not intensity.is_zero and not intensity.is_constant,
        ignored=frozenset(
            m.name for i, m in enumerate(MARKS) if 0 < look.n_points == look.marked[i + 1] and m.of_choice
        ),
    )


def reasons(
    where: str,
    look: Look,
    decision: Decision,
    has_color: bool,
    is_float: bool,
    usual_top: float,
    has_intensity: bool,
    n_points: int,
) -> list[str]:
    """Warnings that say what was decided and from what."""
    seen = "all points" if look.n_points >= n_points else f"{look.n_points:,} of {n_points:,} points sampled"
    found = []
    if has_color and decision.top is None:
        is_zero = look.color.is_zero
        value = (
            "0"
            if is_zero
            else f"{look.color.first[0]:g} in {look.color.n_as_first:,} of {look.color.n_points:,} points"
        )
        found.append(f"{where}: its colours are {value} in {seen} and are not used")
    elif has_color:
        choice = range_of(look.color, is_float, usual_top)
        if not choice.usual or choice.n_beyond:
            beyond = f"; {choice.n_beyond:,} values beyond are as bright as can be shown" if choice.n_beyond else ""
            found.append(
                f"{where}: its colours are taken as {_NAMES.get(choice.top, '')}0 to {choice.top:g} ({choice.why}, of {seen}){beyond}"
            )
        if look.color.n_negative:
            found.append(
                f"{where}: {look.color.n_negative:,} of its colour values are below 0 and drawn as 0, of {seen}"
            )
    if has_intensity and not decision.intensity and decision.top is None:  # else it would not be drawn anyway
        what = "0" if look.intensity.is_zero or look.intensity.first is None else f"{look.intensity.first[0]:g}"
        share = "" if look.intensity.n_as_first == look.intensity.n_points else " nearly"
        found.append(f"{where}: its intensity is{share} constant ({what}) in {seen} and is not used")
    for mark in MARKS:
        if mark.name in decision.ignored:
            found.append(f"{where}: {seen} {mark.text}, so that tells none from another and is ignored")
    return found
