"""The columns of a small file, read when it was opened and kept for whoever reads its points next: libe57 takes them apart once.

A process keeps those of one file, until they are taken or another is opened.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class _Kept:
    path: str
    state: tuple[int, int, int]
    columns: tuple[dict[str, np.ndarray], ...]


_last: list[_Kept] = []


def state_of(path: str) -> tuple[int, int, int]:
    """What tells a file from one that took its place."""
    found = os.stat(path)
    return found.st_ino, found.st_size, found.st_mtime_ns


def keep(path: str, state: tuple[int, int, int], columns: tuple[dict[str, np.ndarray], ...]) -> None:
    """Columns (n,) by the names of fields, of each station, of a file that was in `state` before they were read."""
    _last[:] = [_Kept(path, state, columns)]


def take(path: str) -> tuple[dict[str, np.ndarray], ...] | None:
    """What was kept of a file, once; None where that is nothing, or the file is another since."""
    if not _last or _last[0].path != path:
        return None
    kept = _last.pop()
    return kept.columns if kept.state == state_of(path) else None
