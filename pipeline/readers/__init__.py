"""Readers: one format, one file; each returns a `pipeline.scan.ScanSource`."""

from pipeline.readers.detect import open_scan
from pipeline.readers.inspect import inspect_scan, summarise

__all__ = ["inspect_scan", "open_scan", "summarise"]
