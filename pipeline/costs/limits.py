"""What holds a job back first."""

from __future__ import annotations

from pipeline.costs.job import Job, StagePlan
from pipeline.execution.executors import MOST_A_CALL


def first_limit(job: Job, plans: list[StagePlan], memory_bytes: float) -> tuple[str, str]:
    """What holds a job back first, and what to do about it: two texts."""
    over = [p for p in plans if p.worker_bytes > memory_bytes]
    if over:
        worst = max(over, key=lambda p: p.worker_bytes)
        return (
            f"memory: {worst.name} needs {worst.worker_bytes / 2**30:.1f} GiB of a worker",
            "split the scan into jobs of a region each: the stage holds something of every splat",
        )
    total = sum(p.seconds for p in plans)
    once = sum(p.once_s for p in plans)
    held_up = sum(
        p.dispatch_s for p in plans if p.dispatch_s > 0.9 * (p.seconds - p.once_s) and p.n_tasks > job.n_workers
    )
    worst = max(plans, key=lambda p: p.once_s)
    if held_up > total / 3:
        return "the scheduler: calls end faster than it hands them out", f"larger calls: more than {MOST_A_CALL} tasks"
    if once > total / 2:
        return (
            f"what one process does alone: {100 * once / total:.0f} % of the time, most of it {worst.name}",
            "split the scan into jobs of a region each; more workers help little",
        )
    return "nothing: workers are busy most of the time", "more workers"
