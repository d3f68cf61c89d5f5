"""Where tasks run: a loop in this process, or Dask. The same tasks, the same bytes."""

from __future__ import annotations

import asyncio
import queue
import time
import uuid
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

from pipeline.execution.calls import run_call
from pipeline.execution.stage import Stage
from pipeline.execution.task import run_task, run_tasks
from storage.errors import ResourceExhausted
from storage.work.work import TaskRecord

WATCH_S = 0.5  # how often a waiting executor asks whether it is still wanted
MOST_A_CALL = 32  # tasks, of which one that takes longer than CALL_S hands back what it has not begun
MOST_SERVED = 200  # workers that one scheduler, at 1.3 ms a call, hands a call of a quarter second each; calls get no smaller for more
CLIENT_INTERVAL_S = (
    1e-3  # what is submitted waits no longer for more: Dask's 10 ms, twice a stage, were 3 % of a small job
)
GRACE_S = 3.0  # what running tasks get to end by themselves once they are not
DASK_SETTINGS = {
    "distributed.nanny.pre-spawn-environ": dict.fromkeys(
        ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
    ),
    "distributed.worker.memory.spill": False,
    "distributed.worker.preload": ["pipeline.warm"],
    # What Dask does by itself, five to fifty times as often by default, took 3 % of two busy cores.
    "distributed.worker.profile.interval": "100ms",
    "distributed.worker.memory.monitor-interval": "500ms",
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "2s",
}


class SerialExecutor:
    """One task after the other, here: a failure anywhere shows up in a plain loop."""

    n_workers = 1

    def __enter__(self) -> SerialExecutor:
        return self

    def __exit__(self, *_) -> None:
        pass

    def run(self, stage: Stage, folder: Path, indices: list[int], on_done: Callable[[int, TaskRecord], None]) -> None:
        for index in indices:
            on_done(index, run_task(stage, folder, index))

    def call(self, name: str, function: Callable, *arguments):
        return run_call(name, function, *arguments)


class DaskExecutor:
    """Tasks on Dask workers: a cluster of processes on this machine, or any scheduler's.

    Work folders must be visible to every worker under the same path. Tasks are named by their stage, so that the
    dashboard reads as the pipeline, and annotated with `job`. `watch` is called while tasks run, at least every
    WATCH_S; what it raises stops them: those under way get GRACE_S, then their workers are started anew, for a thread
    cannot be stopped and Dask would only forget it. `resources` are those that a worker must have. `on_lost` hears, in
    a thread of Dask's, which of these tasks a worker that is gone had been given; they run again elsewhere.
    `beside_start` is called while processes of this machine start.
    """

    def __init__(
        self,
        n_workers: int | None = None,
        scheduler: str | None = None,
        *,
        job: str | None = None,
        resources: Mapping[str, float] | None = None,
        watch: Callable[[], None] = lambda: None,
        on_lost: Callable[[str, list[str]], None] | None = None,
        beside_start: Callable[[], object] = lambda: None,
    ) -> None:
        self._n_workers, self._scheduler, self._beside_start = n_workers, scheduler, beside_start
        self._job, self._resources, self._watch, self._on_lost = job, resources, watch, on_lost
        self._wanted: set[str] = set()  # keys of the tasks under way

    def __enter__(self) -> DaskExecutor:
        import dask
        from distributed import Client, LocalCluster

        self._cluster = None
        if self._scheduler is None:
            with dask.config.set(DASK_SETTINGS), ThreadPoolExecutor(1) as thread:
                starting = thread.submit(
                    LocalCluster,
                    n_workers=self._n_workers,
                    threads_per_worker=1,
                    processes=True,
                    dashboard_address="127.0.0.1:0",  # whoever reaches it reads what runs here
                    silence_logs="ERROR",
                )
                self._beside_start()
                self._cluster = starting.result()
        self._client = Client(self._cluster or self._scheduler, set_as_default=False)
        self._client.scheduler_comm.interval = CLIENT_INTERVAL_S
        self.n_workers = max(1, len(self._client.scheduler_info()["workers"]))
        if self._on_lost is not None:
            self._client.subscribe_topic("all", self._hear)
        return self

    def scheduler_id(self) -> str:
        """Of the scheduler that answers now; another one after every start. Raises OSError where none does."""
        return self._client.scheduler_info()["id"]

    @property
    def client(self):
        return self._client

    def __exit__(self, *_) -> None:
        if self._on_lost is not None:  # else the scheduler tells this client that it went, which it complains of
            with suppress(Exception):
                self._client.unsubscribe_topic("all")
        self._client.close()
        if self._cluster is not None:
            self._cluster.close()

    def run(self, stage: Stage, folder: Path, indices: list[int], on_done: Callable[[int, TaskRecord], None]) -> None:
        ends = list(accumulate(calls_of(len(indices), self.n_workers)))
        parts = [indices[begin:end] for begin, end in pairwise([0, *ends])]

        def on_call(arguments: tuple, records: list[TaskRecord]) -> list[tuple]:
            part = arguments[-1]
            for index, record in zip(part, records):
                on_done(index, record)
            size = len(records)
            return [(stage, folder, part[at : at + size]) for at in range(size, len(part), size)]

        self._gather(stage.name, run_tasks, [(stage, folder, part) for part in parts], self._resources, on_call)

    def call(
        self,
        name: str,
        function: Callable,
        *arguments,
        resources: Mapping[str, float] | None = None,
        meanwhile: Callable[[], None] = lambda: None,
    ):
        """The result of one call on a worker that has `resources`; `meanwhile` is called while it runs."""
        results: list[object] = []

        def on_call(_, result: object) -> list[tuple]:
            results.append(result)
            return []

        self._gather(name, run_call, [(name, function, *arguments)], resources or self._resources, on_call, meanwhile)
        return results[0]

    def _hear(self, event: tuple[float, dict]) -> None:
        _, message = event
        if message.get("action") == "remove-worker":
            lost = sorted(self._wanted & {str(key) for key in message["processing-tasks"]})
            if lost:
                self._on_lost(message["worker"], lost)

    def _gather(
        self,
        name: str,
        function: Callable,
        calls: list[tuple],
        resources: Mapping[str, float] | None,
        on_call: Callable[[tuple, Any], list[tuple]],
        meanwhile: Callable[[], None] = lambda: None,
    ) -> None:
        """Call `function` with each of these arguments; `on_call(arguments, result)` says what is to be called
        besides."""
        import dask
        from distributed import KilledWorker

        unique = uuid.uuid4().hex[:8]
        ready: queue.SimpleQueue = queue.SimpleQueue()
        waiting: dict = {}  # future -> arguments
        self._wanted = set()

        def submit(calls: list[tuple], priority: int) -> None:
            keys = [f"{name}-{unique}-{len(self._wanted) + i}" for i in range(len(calls))]
            self._wanted.update(keys)
            with dask.annotate(job=self._job):
                futures = self._client.map(
                    function, *zip(*calls), key=keys, pure=False, resources=resources, priority=priority
                )
            waiting.update(zip(futures, calls))
            for future in futures:
                future.add_done_callback(ready.put)

        try:
            if calls:
                submit(calls, 0)
            while waiting:
                self._watch()
                meanwhile()
                done = list(_waiting(ready))
                if not done:
                    continue
                if any(
                    future.status != "finished" for future in done
                ):  # Dask blames what waited behind a call that killed its worker too
                    done = [future for future in waiting if future.status == "error"][:1] or done
                more = [
                    call
                    for future, result in zip(done, self._results(done))
                    for call in on_call(waiting.pop(future), result)
                ]
                if more:
                    submit(more, 1)  # what is left of a large call, before the small ones
        except KilledWorker as error:
            raise ResourceExhausted(
                f"stage {name}, task {error.task}",
                "the workers that ran it died",
                hint="most often memory ran out: give the workers more, or start fewer",
            ) from error
        finally:
            self._wanted = set()
            if waiting:
                self._stop(list(waiting))

    def _results(self, futures: list) -> list:
        """Of tasks that are done, or what one that failed raised; a worker may hang before it hands one over, and
        `watch` is called meanwhile."""
        fetching = asyncio.run_coroutine_threadsafe(
            self._client.gather(futures, asynchronous=True), self._client.loop.asyncio_loop
        )
        try:
            while not wait([fetching], WATCH_S).done:
                self._watch()
            return fetching.result()
        finally:
            fetching.cancel()

    def _stop(self, futures: list) -> None:
        keys = {f.key for f in futures}
        try:
            busy = {worker for worker, given in self._client.processing().items() if keys & set(given)}
            busy = busy.union(*self._client.who_has(futures).values())
            self._client.cancel(futures, force=True)
            deadline = time.monotonic() + GRACE_S
            while busy and time.monotonic() < deadline:
                busy = set(self._still_running(keys, sorted(busy), deadline))
            if busy:
                self._client.restart_workers(sorted(busy), timeout=30, raise_for_error=False)
        except (OSError, TimeoutError, ValueError):
            pass  # the scheduler is gone, or a worker of another's cluster has no nanny: nothing is left to stop it with

    def _still_running(self, keys: set, workers: list[str], deadline: float) -> list[str]:
        """Those of `workers` that run one of the tasks, a moment from now; one that does not answer counts as one."""
        time.sleep(0.1)
        try:
            left = max(0.1, deadline - time.monotonic())
            running = self._client.run(_running_keys, workers=workers, on_error="ignore", callback_timeout=left)
        except TimeoutError:
            return workers
        return [worker for worker, found in running.items() if keys & set(found)]


def calls_of(n_tasks: int, n_workers: int) -> list[int]:
    """How many tasks go to a worker at once, call after call: half of a worker's share of what is left (guided
    self-scheduling, Polychronopoulos and Kuck 1987). So a scheduler, at about a millisecond a call, stays ahead of a
    thousand workers, and the last calls, of one task, keep no worker waiting for long.

    >>> calls_of(21, 2)
    [5, 4, 3, 2, 1, 1, 1, 1, 1, 1, 1]
    """
    sizes = []
    while n_tasks:
        sizes.append(min(MOST_A_CALL, max(1, n_tasks // (2 * min(n_workers, MOST_SERVED)))))
        n_tasks -= sizes[-1]
    return sizes


def _waiting(ready: queue.SimpleQueue) -> Iterable:
    """The futures that are done by now; waits for one, but no longer than WATCH_S."""
    try:
        yield ready.get(timeout=WATCH_S)
        while True:
            yield ready.get_nowait()
    except queue.Empty:
        return


def _running_keys(dask_worker) -> list[str]:
    """The keys of the tasks that occupy a thread of a worker, whether anyone still wants them or not."""
    return [str(task.key) for task in dask_worker.state.all_running_tasks]
