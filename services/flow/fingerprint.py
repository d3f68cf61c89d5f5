"""When files count as changed."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from storage import place


def located(scan: Path) -> str:
    """Where stages find a scan, from whichever folder."""
    return str(scan if place.is_remote(scan) else scan.resolve())


def fingerprint(scan: Path) -> str:
    """A hash of the names, sizes and times of a scan's files: changes when they do. In a bucket a scan's name holds its
    hash."""
    if place.is_remote(scan):
        return hashlib.sha256(str(scan).encode()).hexdigest()
    files = sorted(p for p in scan.rglob("*") if p.is_file()) if scan.is_dir() else [scan]
    state = hashlib.sha256()
    for path in files:
        stat = path.stat()
        name = os.fsencode(path.relative_to(scan))
        state.update(name + f"\0{stat.st_size}\0{stat.st_mtime_ns}\n".encode())
    return state.hexdigest()
