"""One task of a stage in one process: threads held to one, its peak memory measured, its result recorded."""

from __future__ import annotations

import time
from pathlib import Path

import psutil
import threadpoolctl

from pipeline.stage import Stage
from storage import work


def run_task(stage: Stage, folder: Path, index: int) -> dict:
    """Run task `index`; returns its result with `seconds` and `peak_rss_bytes`, which is recorded in the folder.

    BLAS gets one thread: workers are as many as cores, and sums must not depend on how many threads share them.
    """
    begun = time.perf_counter()
    _forget_peak()
    with threadpoolctl.threadpool_limits(1):
        result = stage.run(folder, index)
    result = {**result, "seconds": time.perf_counter() - begun, "peak_rss_bytes": _peak_rss_bytes()}
    work.record_task(folder, index, result)
    return result


def _forget_peak() -> None:
    """Let the kernel count this process's peak from here on (proc(5), clear_refs); without it, since its start."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        pass


def _peak_rss_bytes() -> int:
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    return psutil.Process().memory_info().rss
