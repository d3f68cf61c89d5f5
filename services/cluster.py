"""The Dask side of the service: workers of its own on one machine, and a job's performance report.

Ordinary workers have the resource CPU, the render worker GL: one engine, one queue, one dashboard, and no numerical
task where pictures are drawn.
"""

from __future__ import annotations

import os
from contextlib import contextmanager
from pathlib import Path

from pipeline.executors import THREAD_LIMITS

CPU, GL = {"CPU": 1}, {"GL": 1}


@contextmanager
def own_cluster(n_workers: int, scratch: Path):
    """Workers and a render worker as processes under this one, which end with it; yields (scheduler, dashboard)."""
    import dask
    from distributed import LocalCluster, Nanny

    scratch.mkdir(parents=True, exist_ok=True)
    with dask.config.set({
        "distributed.nanny.pre-spawn-environ": THREAD_LIMITS, "distributed.worker.memory.spill": False,
        "temporary-directory": str(scratch),
    }):
        n_workers = n_workers or os.cpu_count() or 1
        with LocalCluster(n_workers=n_workers, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0",
                          silence_logs="ERROR", resources=CPU) as cluster:
            worker = next(iter(cluster.worker_spec.values()))
            cluster.worker_spec["render"] = {"cls": Nanny, "options": {**worker["options"], "resources": GL}}
            cluster.sync(cluster._correct_state)
            yield cluster.scheduler_address, cluster.dashboard_link


@contextmanager
def performance_report(scheduler: str, path: Path):
    """What Dask did meanwhile, as a page of its own at `path`; a job does not fail for want of it."""
    from distributed import Client
    from distributed import performance_report as report

    try:
        made = Client(scheduler, set_as_default=False)
    except (OSError, TimeoutError):  # stages wait for a scheduler that is away; this does not
        yield
        return
    with made as client, client.as_current():
        inside = report(filename=str(path))
        inside.__enter__()
        try:
            yield
        finally:
            try:
                inside.__exit__(None, None, None)
            except Exception as error:  # the scheduler may be gone, or its plots may fail on a task's odd timing
                path.with_suffix(".txt").write_text(f"no performance report: {type(error).__name__}: {error}\n")
