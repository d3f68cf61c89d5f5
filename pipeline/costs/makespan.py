"""How long equal tasks take that one scheduler hands to workers: a simulation."""

from __future__ import annotations

import heapq

MOST_SIMULATED = 20_000  # tasks of a stage; more go on as the last of these did


def makespan(n_tasks: int, task_s: float, n_workers: int, dispatch_s: float) -> float:
    """Seconds until equal tasks are done: one scheduler hands each to the worker that is free first."""
    simulated = min(n_tasks, MOST_SIMULATED)
    free = [0.0] * min(n_workers, simulated)
    scheduler, ends = 0.0, [0.0, 0.0]
    for i in range(simulated):
        scheduler = max(scheduler, free[0]) + dispatch_s
        heapq.heapreplace(free, scheduler + task_s)
        if i == simulated // 2:
            ends[0] = scheduler
    if simulated == 0:
        return 0.0
    ends[1] = scheduler
    rate = (ends[1] - ends[0]) / max(1, simulated - 1 - simulated // 2)
    return max(free) + (n_tasks - simulated) * rate
