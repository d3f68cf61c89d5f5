"""One writer a stage's folder, among the processes of a machine, of a shared disk that knows locks, or on a bucket."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

from storage import place


def stage_lock(folder: Path, check: Callable[[], None] = lambda: None) -> AbstractContextManager[None]:
    """Jobs on the same scan share it. The kernel frees the lock of a process that died; a lease runs out."""
    return place.alone(folder.with_name(folder.name + ".lock"), check)
