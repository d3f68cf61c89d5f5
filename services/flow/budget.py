"""A budget of bytes in place of a target: the Lagrange multiplier of atoms at which the packed file keeps it.

Bytes fall as the multiplier rises, nearly as a power of it, so each trial's straight line of logarithms tells the next
multiplier.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from storage.errors import InvalidScan

LEAST, AIM = 0.98, 0.992  # of a budget: what is good enough, and what is tried for
MOST_TRIALS = 8
NO_ATOMS = math.inf  # at it no patch takes an atom
SLOPE = (
    -0.6
)  # of log(bytes of atoms) over log(multiplier), for the second trial: -0.35 to -0.6 on fountain_p11 and monstree
STEEPEST, FLATTEST = -2.0, -0.3


@dataclass(frozen=True)
class Trial:
    """What a multiplier gave."""

    multiplier: float
    n_bytes: float  # on the GPU
    result: Any


def within_budget(
    budget_bytes: float, n_splats: int, first_multiplier: float, attempt: Callable[[float], Trial]
) -> Trial:
    """The best trial that keeps `budget_bytes` a splat: from LEAST of it on, or what splats take when atoms cost next
    to nothing.

    Raises: InvalidScan where a file without any atom is larger.
    """
    budget = budget_bytes * n_splats
    bare = attempt(NO_ATOMS)
    check_budget(budget_bytes, n_splats, bare.n_bytes)
    room, multiplier, trials = AIM * budget - bare.n_bytes, first_multiplier, [bare]
    while room > 0 and len(trials) <= MOST_TRIALS:
        trials.append(attempt(multiplier))
        if LEAST * budget <= trials[-1].n_bytes <= budget or _takes_no_more(trials[1:]):
            break
        multiplier = _next_multiplier(trials[1:], bare.n_bytes, room)
    return max((t for t in trials if t.n_bytes <= budget), key=lambda t: t.n_bytes)


def check_budget(budget_bytes: float, n_splats: int, n_bytes: float) -> None:
    """Raises InvalidScan where `n_bytes`, which no multiplier lowers, exceed the budget."""
    if n_bytes > budget_bytes * n_splats:
        raise InvalidScan(
            "budget_bytes",
            f"{budget_bytes:g} bytes a splat, of which geometry, colours and dictionary alone take {n_bytes / n_splats:.2f}",
            f"{math.ceil(100 * n_bytes / n_splats) / 100:.2f} and more",
            "a density below 1 leaves out splats",
        )


def _next_multiplier(trials: list[Trial], bare: float, room: float) -> float:
    """Where the line of logarithms through two trials has the room: the nearest on either side of it, or the last
    two."""
    points = [(math.log(t.multiplier), math.log(max(1.0, t.n_bytes - bare) / room)) for t in trials]
    over, under = (
        max((p for p in points if p[1] > 0), default=None),
        min((p for p in points if p[1] <= 0), default=None),
    )
    if over and under:
        halves = len(points) > 2 and points[-1][1] * points[-2][1] > 0  # the line bends: the middle, once in two
        return math.exp((over[0] + under[0]) / 2 if halves else _root(over, under))
    slope = SLOPE
    if len(points) > 1 and points[-1][0] != points[-2][0]:
        slope = (points[-1][1] - points[-2][1]) / (points[-1][0] - points[-2][0])
    found = points[-1][0] - points[-1][1] / min(FLATTEST, max(STEEPEST, slope))
    if len(points) > 1 and not under:  # where splats have all the atoms that they may have the line is level
        is_level = points[-2][1] - points[-1][1] < 0.01
        found = max(found, points[-1][0] + math.log(4 if is_level else 2))
    return math.exp(found)


def _root(a: tuple[float, float], b: tuple[float, float]) -> float:
    return a[0] - a[1] * (b[0] - a[0]) / (b[1] - a[1])


def _takes_no_more(trials: list[Trial]) -> bool:
    """Whether a much lower multiplier has bought hardly anything: splats have all the atoms that they may have."""
    if len(trials) < 2:
        return False
    before, last = trials[-2:]
    return last.multiplier < before.multiplier / 4 and last.n_bytes < 1.002 * before.n_bytes
