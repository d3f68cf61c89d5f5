"""One task of a stage in one process: threads held to one, its peak memory measured, its result recorded."""

from __future__ import annotations

import errno
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import psutil
import threadpoolctl

from storage import work
from storage.errors import ResourceExhausted

if TYPE_CHECKING:
    from pipeline.stage import Stage


def run_task(stage: Stage, folder: Path, index: int) -> dict:
    """Run task `index`; returns its result with `seconds`, `processor_seconds` and `peak_rss_bytes`, which
    is recorded in the folder.

    BLAS gets one thread: workers are as many as cores, and sums must not depend on how many threads share them.
    """
    begun, begun_processor = time.perf_counter(), time.process_time()
    _forget_peak()
    with _named(stage.name), threadpoolctl.threadpool_limits(1):
        result = stage.run(folder, index)
        result = {**result, "seconds": time.perf_counter() - begun, "peak_rss_bytes": _peak_rss_bytes(),
                  "processor_seconds": time.process_time() - begun_processor}
        work.record_task(folder, index, result)
    return result


def run_tasks(stage: Stage, folder: Path, indices: list[int]) -> list[dict]:
    """Several tasks as one: their results. Those that were done before a worker died are not done again."""
    return [work.finished_task(folder, index) or run_task(stage, folder, index) for index in indices]


def run_call(name: str, function: Callable, *arguments):
    """What stage `name` does around its tasks, under the same rules."""
    with _named(name), threadpoolctl.threadpool_limits(1):
        return function(*arguments)


@contextmanager
def _named(name: str) -> Iterator[None]:
    """Let an error of the disk say which stage met it, and look like none of the network between us and a worker."""
    try:
        yield
    except OSError as error:
        raise error_of_disk(name, error) from error


def error_of_disk(stage: str, error: OSError) -> ResourceExhausted:
    """What a stage that met it says to its user: no path of this machine."""
    file = f" ({Path(error.filename).name})" if isinstance(error.filename, str) else ""
    hint = "free some, then retry: what is done stays done" if error.errno in (errno.ENOSPC, errno.EDQUOT) else ""
    return ResourceExhausted(f"stage {stage}", (error.strerror or f"{error}") + file, hint=hint)


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
