"""Where tasks run: a loop in this process, or Dask. The same tasks, the same bytes."""

from __future__ import annotations

import queue
import time
import uuid
from collections.abc import Callable, Iterable
from pathlib import Path

from pipeline.stage import Stage
from pipeline.task import run_task
from storage.errors import ResourceExhausted

WATCH_S = 0.5  # how often a waiting executor asks whether it is still wanted
GRACE_S = 3.0  # what running tasks get to end by themselves once they are not
THREAD_LIMITS = {name: "1" for name in (
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS",
)}


class SerialExecutor:
    """One task after the other, here: a failure anywhere shows up in a plain loop."""

    n_workers = 1

    def __enter__(self) -> SerialExecutor:
        return self

    def __exit__(self, *_) -> None:
        pass

    def run(self, stage: Stage, folder: Path, indices: list[int], on_done: Callable[[int, dict], None]) -> None:
        for index in indices:
            on_done(index, run_task(stage, folder, index))


class DaskExecutor:
    """Tasks on Dask workers: a cluster of processes on this machine, or any scheduler's.

    Work folders must be visible to every worker under the same path. Tasks are named by their stage, so that the
    dashboard reads as the pipeline, and annotated with `job`. `watch` is called while tasks run, at least every
    WATCH_S; what it raises stops them: those under way get GRACE_S, then their workers are started anew, for a thread
    cannot be stopped and Dask would only forget it. `resources` are those that a worker must have.
    """

    def __init__(self, n_workers: int | None = None, scheduler: str | None = None, *, job: str | None = None,
                 resources: dict[str, float] | None = None, watch: Callable[[], None] = lambda: None) -> None:
        self._n_workers, self._scheduler = n_workers, scheduler
        self._job, self._resources, self._watch = job, resources, watch

    def __enter__(self) -> DaskExecutor:
        import dask
        from distributed import Client, LocalCluster

        self._cluster = None
        if self._scheduler is None:
            with dask.config.set({"distributed.nanny.pre-spawn-environ": THREAD_LIMITS, "distributed.worker.memory.spill": False}):
                self._cluster = LocalCluster(
                    n_workers=self._n_workers, threads_per_worker=1, processes=True, dashboard_address=":0",
                    silence_logs="ERROR",
                )
        self._client = Client(self._cluster or self._scheduler, set_as_default=False)
        scheduler = self._client.scheduler_info()
        self.scheduler_id = scheduler["id"]  # another one after every start
        self.n_workers = max(1, len(scheduler["workers"]))
        return self

    def __exit__(self, *_) -> None:
        self._client.close()
        if self._cluster is not None:
            self._cluster.close()

    def run(self, stage: Stage, folder: Path, indices: list[int], on_done: Callable[[int, dict], None]) -> None:
        calls = {index: (run_task, stage, folder, index) for index in indices}
        self._gather(stage.name, calls, self._resources, on_done)

    def call(self, name: str, function: Callable, *arguments, resources: dict[str, float] | None = None,
             meanwhile: Callable[[], None] = lambda: None):
        """The result of one call on a worker that has `resources`; `meanwhile` is called while it runs."""
        results: dict[int, object] = {}
        self._gather(name, {0: (function, *arguments)}, resources, results.__setitem__, meanwhile)
        return results[0]

    def _gather(self, name: str, calls: dict[int, tuple], resources: dict[str, float] | None,
                on_done: Callable[[int, dict], None], meanwhile: Callable[[], None] = lambda: None) -> None:
        import dask
        from distributed import KilledWorker

        unique = uuid.uuid4().hex[:8]
        with dask.annotate(job=self._job):
            futures = {
                self._client.submit(*call, key=f"{name}-{unique}-{i}", pure=False, resources=resources): i
                for i, call in calls.items()
            }
        ready: queue.SimpleQueue = queue.SimpleQueue()
        for future in futures:
            future.add_done_callback(ready.put)
        finished = False
        try:
            n_missing = len(futures)
            while n_missing:
                self._watch()
                meanwhile()
                for future in _waiting(ready):
                    on_done(futures[future], future.result())
                    future.release()
                    n_missing -= 1
            finished = True
        except KilledWorker as error:
            raise ResourceExhausted(
                f"stage {name}, task {error.task}", "the workers that ran it died",
                hint="most often memory ran out: give the workers more, or start fewer",
            ) from error
        finally:
            if not finished:
                self._stop([f for f in futures if not f.done()])

    def _stop(self, futures: list) -> None:
        keys = {f.key for f in futures}
        self._client.cancel(futures, force=True)
        deadline = time.monotonic() + GRACE_S
        try:
            while busy := [worker for worker, running in self._client.run(_running_keys).items() if keys & set(running)]:
                if time.monotonic() > deadline:
                    self._client.restart_workers(busy, timeout=30, raise_for_error=False)
                    return
                time.sleep(0.1)
        except (OSError, TimeoutError, ValueError):
            pass  # the scheduler is gone, or a worker of another's cluster has no nanny: nothing is left to stop it with


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
