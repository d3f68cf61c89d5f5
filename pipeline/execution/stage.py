"""What a stage is, and how one is run: init, then run each task, then finalise. Names no executor.

A stage is a frozen dataclass of plain values and folders of earlier stages. Its output goes to a folder of its own,
named by the hash of those fields; a task writes only what it owns there and returns a small frozen dataclass, kept as
JSON.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar, get_type_hints

from pipeline.execution.calls import run_call
from storage import place
from storage.work import work
from storage.work.work import TaskRecord

S = TypeVar("S")
S_co = TypeVar("S_co", covariant=True)


class Stage(Protocol[S_co]):
    """The three steps.

    `init` runs in the process that calls `run_stage`, the other two wherever the executor says, perhaps more than once
    and side by side (a worker that was given up may still be at it): equal calls make equal bytes.
    """

    name: str

    def init(self, folder: Path) -> int:
        """Create the arrays; returns the number of tasks."""

    def run(self, folder: Path, index: int) -> Any:
        """Do task `index`: write the chunks it owns, return what finalise needs, a frozen dataclass; `n_splats` of it
        is what the progress counts."""

    def finalise(self, folder: Path, results: list) -> S_co:
        """Make one summary of the results, in the order of the tasks: a frozen dataclass (`pipeline.summaries`)."""


class Executor(Protocol):
    """Runs the tasks of a stage anywhere, in any order; `on_done(index, record)` is called once for each.

    `call` runs `finalise` where tasks run: it too may take long, must be stoppable, and takes memory.
    """

    n_workers: int

    def run(
        self, stage: Stage, folder: Path, indices: list[int], on_done: Callable[[int, TaskRecord], None]
    ) -> None: ...

    def call(self, name: str, function: Callable, *arguments): ...


@dataclass(frozen=True)
class StageRecord(Generic[S]):
    """What a stage did and cost."""

    name: str
    folder: Path
    summary: S
    seconds: float
    peak_rss_bytes: int  # of the worker that needed most
    n_tasks: int
    n_splats: int
    reused: bool
    made_seconds: float = 0.0  # what it took when it was made, now or by an earlier run


class Progress(Protocol):
    """Hears how a stage comes on."""

    def begin(self, name: str, n_tasks: int) -> None: ...

    def advance(self, name: str, n_tasks: int, n_splats: int) -> None: ...

    def end(self, record: StageRecord) -> None: ...


def run_stage(stage: Stage[S], work_folder: Path, executor: Executor, progress: Progress) -> StageRecord[S]:
    """Bring a stage's output into being, doing only what is missing.

    Guarantees: a complete stage is not run again; after a crash only tasks without a recorded result run.
    """
    begun = time.perf_counter()
    folder = work.stage_folder(work_folder, stage)
    reused = work.is_complete(folder)
    tasks = (work.finished_tasks(folder) if reused else _bring_into_being(stage, folder, executor, progress)).values()
    record = StageRecord(
        stage.name,
        folder,
        work.summary(folder, summary_type(stage)),
        time.perf_counter() - begun,
        max((task.peak_rss_bytes for task in tasks), default=0),
        len(tasks),
        sum(task.n_splats for task in tasks),
        reused,
        work.made_seconds(folder),
    )
    progress.end(record)
    return record


def summary_type(stage: Stage) -> Any:
    """What `finalise` of a stage returns, by its annotation; a stage that may stand for several says which by a
    property `summary_type`."""
    return getattr(stage, "summary_type", None) or get_type_hints(type(stage).finalise)["return"]


def result_type(stage: Stage) -> Any:
    """What `run` of a stage returns, by its annotation."""
    return get_type_hints(type(stage).run)["return"]


def _bring_into_being(stage: Stage, folder: Path, executor: Executor, progress: Progress) -> dict[int, TaskRecord]:
    """Its tasks: their records are not read again, which one process would do for all."""
    begun, plan = time.perf_counter(), folder / "plan.json"
    if place.is_file(plan):
        work.sweep(folder)
    else:
        work.begin(folder)
        run_call(stage.name, lambda: work.write_json(plan, {"n_tasks": stage.init(folder)}))
    n_tasks = work.read_json(plan)["n_tasks"]
    tasks = work.finished_tasks(folder, result_type(stage))
    progress.begin(stage.name, n_tasks)
    progress.advance(stage.name, len(tasks), sum(task.n_splats for task in tasks.values()))

    def on_done(index: int, task: TaskRecord) -> None:
        tasks[index] = task
        progress.advance(stage.name, 1, task.n_splats)

    try:
        executor.run(stage, folder, [i for i in range(n_tasks) if i not in tasks], on_done)
        summary = executor.call(stage.name, stage.finalise, folder, [tasks[i].result for i in range(n_tasks)])
        run_call(stage.name, work.complete, folder, summary, time.perf_counter() - begun)
    except BaseException:
        work.sweep(folder)
        raise
    return tasks
