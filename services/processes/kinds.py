"""What a job may do with its scan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pipeline.planning.knobs import BY_NAME

BUDGET_S = 600.0  # of a tradeoff, unless told otherwise
COMPRESS, TRADEOFF = PROCESSES = ("compress", "tradeoff")


PERFORMANCE = "dask-performance.html"  # an artifact for whoever runs the service


def check_knobs(process: str, knobs: Mapping[str, Sequence] | None) -> None:
    """Raises ValueError for knobs that are not allowed, or of no use to the process."""
    if process == COMPRESS and knobs is not None:
        raise ValueError(f"knobs are varied by {TRADEOFF!r} alone; found process {process!r}")
    for name, values in (knobs or {}).items():
        if name not in BY_NAME:
            raise ValueError(f"{name!r} is no knob; allowed: {', '.join(BY_NAME)}")
        for value in values:
            BY_NAME[name].checked(value)
