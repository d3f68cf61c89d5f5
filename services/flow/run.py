"""One job under way."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from pipeline.execution.stage import Executor, Progress, Stage, StageRecord, run_stage
from renderer.report.document import ViewMeasured
from services.flow.previews import previews_of

S = TypeVar("S")


def _at_once(stage: Stage, do: Callable[[], StageRecord]) -> StageRecord:
    return do()


def _here(function: Callable, *arguments):
    return function(*arguments)


@dataclass
class Run:
    """One job under way: its stages run into one work folder, and what they cost is kept for the report.

    `step` decides how a stage is brought about (the service makes it a durable step), `draw` where previews are drawn.
    """

    work: Path
    executor: Executor
    progress: Progress
    step: Callable[[Stage, Callable[[], StageRecord]], StageRecord] = _at_once
    draw: Callable[[Path, Path, Path, Callable[[int, int], None]], list[ViewMeasured]] = previews_of
    paint: Callable = _here  # how other pictures are drawn: a function and its arguments
    round: Callable[[int, int], None] = lambda index, n_rounds: None  # hears which point of a trade-off begins
    clock: Callable[[], float] = time.monotonic
    strict: bool = False  # warnings about the scan are errors
    keeps_work: bool = True  # whether the work folder is there after the job
    records: list[StageRecord] = field(default_factory=list)

    def do(self, stage: Stage[S]) -> StageRecord[S]:
        """Run a stage, and keep what it cost."""
        record: StageRecord[S] = self.step(stage, lambda: run_stage(stage, self.work, self.executor, self.progress))
        self.records.append(record)
        return record
