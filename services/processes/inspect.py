"""What a file is, told from its header alone; and what is wrong with it, told from its points too."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from pipeline.readers import inspect_scan
from pipeline.readers.check import check_scan
from storage.packed.seal import is_packed_file


def inspect(path: Path) -> dict:
    """A JSON-able account of a scan or a packed file."""
    return inspect_packed(path) if is_packed_file(path) else inspect_scan(str(path))


def inspect_packed(path: Path) -> dict:
    """A packed file's header; its seal is checked, so a damaged file is refused."""
    from storage.packed.packed import PackedFile  # zarr takes half a second to import, and scans do without

    with PackedFile(path) as packed:
        header = packed.header.to_json()
    cameras = header.pop("cameras")
    return {**header, "kind": "packed", "file_bytes": path.stat().st_size, "cameras": [c["name"] for c in cameras]}


def check(path: Path) -> dict:
    """A JSON-able account of what is wrong with a scan; `ok` unless a finding is an error."""
    findings = check_scan(str(path))
    return {
        "path": str(path),
        "ok": all(f.severity != "error" for f in findings),
        "findings": [asdict(f) for f in findings],
    }
