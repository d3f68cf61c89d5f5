"""The Dask side of the service: workers of its own on one machine, and a job's performance report.

Ordinary workers have the resource CPU, the render worker GL: one engine, one queue, one dashboard, and no numerical
task where pictures are drawn.
"""

from __future__ import annotations

import os
from contextlib import contextmanager
from pathlib import Path

from pipeline.execution.executors import DASK_SETTINGS

CPU, GL = {"CPU": 1}, {"GL": 1}


@contextmanager
def own_cluster(n_workers: int, scratch: Path):
    """Workers and a render worker as processes under this one, which end with it; yields (scheduler, dashboard)."""
    import dask
    from distributed import LocalCluster, Nanny

    scratch.mkdir(parents=True, exist_ok=True)
    with dask.config.set(DASK_SETTINGS | {"temporary-directory": str(scratch)}):
        n_workers = n_workers or os.cpu_count() or 1
        with LocalCluster(
            n_workers=n_workers,
            threads_per_worker=1,
            processes=True,
            dashboard_address="127.0.0.1:0",
            silence_logs="ERROR",
            resources=CPU,
        ) as cluster:
            worker = next(iter(cluster.worker_spec.values()))
            cluster.worker_spec["render"] = {"cls": Nanny, "options": {**worker["options"], "resources": GL}}
            n_all = len(cluster.worker_spec)
            cluster.scale(n_all)  # brings up what the specification has
            cluster.wait_for_workers(n_all)
            yield cluster.scheduler_address, cluster.dashboard_link


def begin_report(client, path: Path):
    """Let the scheduler keep what Dask does from here on, for `end_report` to make a page of at `path`."""
    from distributed import performance_report

    report = performance_report(filename=str(path))
    with client.as_current():
        report.__enter__()
    return report


def end_report(client, report, timeout_s: float) -> None:
    """A job does not fail for want of it, nor wait for workers that hang, which are asked for their profiles."""
    try:
        with client.as_current():
            client.sync(report.__aexit__, None, None, None, code="", callback_timeout=timeout_s)
    except Exception as error:  # the scheduler may be gone, or its plots may fail on a task's odd timing
        text = f"no performance report: {type(error).__name__}: {error}\n"
        Path(report.filename).with_suffix(".txt").write_text(text)
