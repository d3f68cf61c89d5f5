"""One writer a stage's folder, among the processes of a machine or of a shared disk that knows locks."""

from __future__ import annotations

import fcntl
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

POLL_S = 0.2


@contextmanager
def stage_lock(folder: Path, check: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Jobs on the same scan share it. The kernel frees the lock of a process that died."""
    with open(folder.with_name(folder.name + ".lock"), "w") as lock:
        while True:
            check()
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                time.sleep(POLL_S)
        yield
