"""Readers: one format, one file; each returns a `pipeline.scan.ScanSource`.

What opens a scan is imported when it is first asked for: it takes numpy and numba, and the command line, which knows the
names of knobs and marks from here, answers without.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipeline.readers.detect import open_scan
    from pipeline.readers.inspect import inspect_scan, summarise

__all__ = ["inspect_scan", "open_scan", "summarise"]
_HOMES = {"open_scan": "detect", "inspect_scan": "inspect", "summarise": "inspect"}


def __getattr__(name: str):
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
