"""One task of a stage in one process: its time and peak memory measured, its result recorded."""

from __future__ import annotations

import time
from pathlib import Path

import psutil
from numba.core import event

from pipeline.execution.calls import under_the_rules
from pipeline.execution.stage import Stage, result_type
from storage.work import work
from storage.work.work import TaskRecord

CALL_S = 2.0  # then a call hands back what it has not begun: it can be stopped, and progress is heard, within a task and this


def run_task(stage: Stage, folder: Path, index: int) -> TaskRecord:
    """Run task `index`; what it returned and took, which is recorded in the folder."""
    begun, begun_processor = time.perf_counter(), time.process_time()
    _forget_peak()
    with (
        under_the_rules(stage.name),
        event.install_listener("numba:compiler_lock", event.TimingListener()) as compiling,
    ):
        result = stage.run(folder, index)
        record = TaskRecord(
            result,
            getattr(result, "n_splats", 0),
            seconds=time.perf_counter() - begun,
            processor_seconds=time.process_time() - begun_processor,
            compile_seconds=compiling.duration if compiling.done else 0.0,
            peak_rss_bytes=peak_rss_bytes(),
        )
        work.record_task(folder, index, record)
    return record


def run_tasks(stage: Stage, folder: Path, indices: list[int]) -> list[TaskRecord]:
    """Several tasks as one: the records of the first, and of as many others as begin within CALL_S. Those that were
    done before a worker died are not done again."""
    begun = time.perf_counter()
    kind = result_type(stage)
    records: list[TaskRecord] = []
    for index in indices:
        if records and time.perf_counter() - begun > CALL_S:
            break
        records.append(work.finished_task(folder, index, kind) or run_task(stage, folder, index))
    return records


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
