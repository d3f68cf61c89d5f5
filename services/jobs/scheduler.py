"""A job's connection to the Dask scheduler: made when a stage first has tasks to run, anew whenever it was lost.

All that a stage has done is on disk and nothing in Dask, so a scheduler that is gone costs no more than the tasks it
had under way. What happens to it and to its workers goes into the job's log.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import CancelledError
from pathlib import Path

from pipeline.execution.executors import DaskExecutor
from pipeline.execution.stage import Stage
from services.jobs.cluster import CPU, begin_report, end_report
from services.store.store import Store
from storage.errors import ResourceExhausted
from storage.work.work import TaskRecord

RECONNECT_S = 120.0  # how long a job waits for a scheduler that is gone
RETRY_S = 1.0
REPORT_S, REPORT_OF_FAILURE_S = 30.0, 2.0  # one takes 0.8 s; a dismissed job is to stop within ten


class SchedulerLink:
    """An `Executor` on one scheduler; `address()` gives the one that is good now, `check` raises to end a job's
    waiting."""

    n_workers = 1

    def __init__(
        self,
        address: Callable[[], str],
        store: Store,
        job: str,
        check: Callable[[], None],
        report: Path,
        report_from_s: float,
    ) -> None:
        self._address, self._store, self._job, self._check, self._report_path = address, store, job, check, report
        self._report_due = time.monotonic() + report_from_s
        self._executor: DaskExecutor | None = None
        self._report = None
        self._met = ""  # the scheduler's id; another one after every start

    def __enter__(self) -> SchedulerLink:
        return self

    def __exit__(self, error: type | None, *_) -> None:
        """Leaves Dask's performance report, if the job was long enough and there is a scheduler to ask."""
        if self._executor is not None and time.monotonic() >= self._report_due:
            end_report(self._executor.client, self._report, REPORT_S if error is None else REPORT_OF_FAILURE_S)
        self._close()

    def run(self, stage: Stage, folder: Path, indices: list[int], on_done: Callable[[int, TaskRecord], None]) -> None:
        missing = set(indices)

        def note(index: int, record: TaskRecord) -> None:
            missing.discard(index)
            on_done(index, record)

        if missing:
            self._use(lambda executor: executor.run(stage, folder, sorted(missing), note))

    def call(self, name: str, function: Callable, *arguments, **how):
        return self._use(lambda executor: executor.call(name, function, *arguments, **how))

    def _use(self, what: Callable[[DaskExecutor], object]):
        deadline = None
        while True:
            self._check()
            try:
                return what(self._reached())
            except (
                OSError,
                TimeoutError,
                CancelledError,
            ) as error:  # tasks raise none of these (pipeline/execution/task.py)
                self._close()
                deadline = deadline or time.monotonic() + RECONNECT_S
                if time.monotonic() > deadline:
                    raise ResourceExhausted(
                        "Dask", f"no scheduler for {RECONNECT_S:g} s ({type(error).__name__}: {error})"
                    ) from error
                self._warn(f"no scheduler ({type(error).__name__}); going on when there is one")
                time.sleep(RETRY_S)

    def _reached(self) -> DaskExecutor:
        if self._executor is None:
            made = DaskExecutor(
                scheduler=self._address(), job=self._job, resources=CPU, watch=self._check, on_lost=self._lost
            )
            self._executor = made.__enter__()
            self._report = begin_report(made.client, self._report_path)
        found = self._executor.scheduler_id()
        if (
            self._met and found != self._met
        ):  # also where it was lost between two stages, and Dask reached the next unseen
            self._warn("the scheduler was lost; going on with the one in its place")
        self._met = found
        return self._executor

    def _lost(self, worker: str, tasks: list[str]) -> None:
        names = sorted({key.rpartition("-")[0].rpartition("-")[0] for key in tasks})
        self._warn(f"worker {worker} was lost with {len(tasks)} tasks of {', '.join(names)}; they run again")

    def _warn(self, text: str) -> None:
        self._store.log(self._job, "warning", text)

    def _close(self) -> None:
        executor, self._executor = self._executor, None
        if executor is not None:
            executor.__exit__(None, None, None)
