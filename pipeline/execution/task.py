"""One task of a stage in one process: its time and peak memory measured, its result recorded."""

from __future__ import annotations

import time
from pathlib import Path

import psutil
from numba.core import event

from pipeline.execution.calls import under_the_rules
from pipeline.execution.stage import Stage
from storage.work import work

CALL_S = 2.0  # then a call hands back what it has not begun: it can be stopped, and progress is heard, within a task and this


def run_task(stage: Stage, folder: Path, index: int) -> dict:
    """Run task `index`; returns its result with `seconds`, `processor_seconds` and `peak_rss_bytes`, which
    is recorded in the folder. `compile_seconds`, part of the seconds, went into kernels that a process compiles or
    loads once."""
    begun, begun_processor = time.perf_counter(), time.process_time()
    _forget_peak()
    with (
        under_the_rules(stage.name),
        event.install_listener("numba:compiler_lock", event.TimingListener()) as compiling,
    ):
        result = stage.run(folder, index)
        result = {
            **result,
            "seconds": time.perf_counter() - begun,
            "peak_rss_bytes": peak_rss_bytes(),
            "processor_seconds": time.process_time() - begun_processor,
            "compile_seconds": compiling.duration if compiling.done else 0.0,
        }
        work.record_task(folder, index, result)
    return result


def run_tasks(stage: Stage, folder: Path, indices: list[int]) -> list[dict]:
    """Several tasks as one: the results of the first, and of as many others as begin within CALL_S. Those that were
    done before a worker died are not done again."""
    begun = time.perf_counter()
    results: list[dict] = []
    for index in indices:
        if results and time.perf_counter() - begun > CALL_S:
            break
        results.append(work.finished_task(folder, index) or run_task(stage, folder, index))
    return results


def _forget_peak() -> None:
    """Let the kernel count this process's peak from here on (proc(5), clear_refs); without it, since its start."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        pass


def peak_rss_bytes() -> int:
    """The most memory that this process has held since it began, or since `_forget_peak`."""
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    return psutil.Process().memory_info().rss
