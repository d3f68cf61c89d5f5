"""The rules under which all work of a stage runs: one thread of BLAS, and errors of the disk that name the stage."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from pipeline.execution.threads import one_thread_a_library
from storage.errors import ResourceExhausted


def run_call(name: str, function: Callable, *arguments):
    """What stage `name` does around its tasks, under the rules of its tasks."""
    with under_the_rules(name):
        return function(*arguments)


@contextmanager
def under_the_rules(name: str) -> Iterator[None]:
    """BLAS gets one thread: workers are as many as cores, and sums must not depend on how many threads share them. An
    error of the disk says which stage met it, and looks like none of the network between us and a worker."""
    try:
        with one_thread_a_library():
            yield
    except OSError as error:
        raise error_of_disk(name, error) from error


def error_of_disk(stage: str, error: OSError) -> ResourceExhausted:
    """What a stage that met it says to its user: no path of this machine."""
    file = f" ({Path(error.filename).name})" if isinstance(error.filename, str) else ""
    hint = "free some, then retry: what is done stays done" if error.errno in (errno.ENOSPC, errno.EDQUOT) else ""
    return ResourceExhausted(f"stage {stage}", (error.strerror or f"{error}") + file, hint=hint)
