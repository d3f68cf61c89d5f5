"""What an effect is to the pipeline: what is measured, from where on it is worth its cost, and its encoder's stage.

An effect is one module or folder of `pipeline/effects` with an `EFFECT`; its shader part, if it has one, is the module
of the same name in `renderer/effects`. Nothing lists them: they are found (`registry.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.effects.block import Block, Sources
from pipeline.execution.stage import Stage


@dataclass(frozen=True)
class Measured:
    """What a scan says of one effect."""

    value: float  # of the measure that decides
    share: float = 0.0  # of splats (of photographs for those that touch photographs) that it would touch, 0 to 1
    outcome: dict = field(default_factory=dict)  # JSON-able: what its encoder or its shader takes from the measure


@dataclass(frozen=True)
class Worth:
    """What an effect costs where it is on, and what it gives, as measured on the scans named in `measured_on`."""

    measured_on: str
    seconds_a_million: float = 0.0  # splats, on one core, its survey included
    bytes_a_splat: float = 0.0  # that it touches; negative where it saves
    frame_share: float = 0.0  # of frame time without it
    gain_db: float | None = None  # PSNR against the photographs; None where that is not what it is for


@dataclass(frozen=True)
class Effect:
    """One effect. All callables are functions of a module, for stages travel to other processes."""

    name: str
    title: str  # what it does, in a line
    measures: str  # what `Measured.value` is, with its unit
    threshold: float  # from this value on the effect is on; `by_request` ones never are of themselves
    reason: str  # of the threshold: what it was set from
    worth: Worth
    measure_block: Callable[[Block], dict] = lambda block: {}  # JSON-able sums of one block of splats
    conclude: Callable[[list[dict], Sources], Measured] = lambda sums, sources: Measured(0.0)
    survey: Callable[[Sources], Stage | None] = lambda sources: None  # what must be there before blocks are measured
    build: Callable[[Sources, dict, Path | None], Stage | None] = lambda sources, outcome, survey: None  # its encoder
    by_request: bool = False
    needs: str | None = None  # an effect of a lower order, without which this one has nothing to work on
    order: int = 50  # of its row in the plan
