"""A lock on a file: one holder among the processes of a machine, or of a shared disk that knows locks. The kernel frees
that of a process that died."""

from __future__ import annotations

import fcntl
from typing import IO


def hold(lock: IO) -> None:
    """Hold the lock of an open file until it is closed; waits for whoever has it."""
    fcntl.flock(lock, fcntl.LOCK_EX)


def try_to_hold(lock: IO) -> bool:
    """Hold it where nobody else does; whether that is so."""
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return True
    except BlockingIOError:
        return False
