"""Where tasks run: a loop in this process, or Dask. The same tasks, the same bytes."""

from __future__ import annotations

import uuid
from collections.abc import Callable
from pathlib import Path

from pipeline.stage import Stage
from pipeline.task import run_task
from storage.errors import ResourceExhausted

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
    dashboard reads as the pipeline.
    """

    def __init__(self, n_workers: int | None = None, scheduler: str | None = None) -> None:
        self._n_workers, self._scheduler = n_workers, scheduler

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
        self._client = Client(self._cluster or self._scheduler)
        self.n_workers = max(1, len(self._client.scheduler_info()["workers"]))
        return self

    def __exit__(self, *_) -> None:
        self._client.close()
        if self._cluster is not None:
            self._cluster.close()

    def run(self, stage: Stage, folder: Path, indices: list[int], on_done: Callable[[int, dict], None]) -> None:
        from distributed import KilledWorker, as_completed

        unique = uuid.uuid4().hex[:8]
        futures = {
            self._client.submit(run_task, stage, folder, i, key=f"{stage.name}-{unique}-{i}", pure=False): i
            for i in indices
        }
        try:
            for future in as_completed(futures):
                on_done(futures[future], future.result())
                future.release()
        except KilledWorker as error:
            raise ResourceExhausted(
                f"stage {stage.name}, task {error.task}", "the workers that ran it died",
                hint="most often memory ran out: give the workers more, or start fewer",
            ) from error
        finally:
            self._client.cancel([f for f in futures if not f.done()], force=True)
