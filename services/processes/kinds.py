"""What a job does with its scan, and how the store keeps that: beside the settings, in the same column."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict

from pipeline.planning.knobs import BY_NAME
from pipeline.planning.settings import Settings

BUDGET_S = 600.0  # of a tradeoff, unless told otherwise
COMPRESS, TRADEOFF = PROCESSES = ("compress", "tradeoff")
_KEY = "process"


def stored(settings: Settings, process: str, knobs: Mapping[str, Sequence] | None, budget_s: float) -> dict:
    """The settings of a job as the store keeps them. Raises ValueError for knobs that are not allowed, or not of
    use."""
    if process == COMPRESS:
        if knobs is not None:
            raise ValueError(f"knobs are varied by {TRADEOFF!r} alone; found process {process!r}")
        return asdict(settings)
    for name, values in (knobs or {}).items():
        if name not in BY_NAME:
            raise ValueError(f"{name!r} is no knob; allowed: {', '.join(BY_NAME)}")
        for value in values:
            BY_NAME[name].checked(value)
    return asdict(settings) | {_KEY: {"name": process, "knobs": knobs, "budget_s": budget_s}}


def settings_of_job(job: dict) -> dict:
    """A job's settings, without what else its row keeps beside them."""
    return {name: value for name, value in job["settings"].items() if name != _KEY}


def process_of_job(job: dict) -> dict:
    """`name`; of a tradeoff `knobs` and `budget_s` too."""
    return job["settings"].get(_KEY, {"name": COMPRESS})
