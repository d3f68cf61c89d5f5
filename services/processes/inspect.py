"""What a file is, told from its header alone; and what is wrong with it, told from its points too."""

from __future__ import annotations

import tempfile
from dataclasses import asdict
from pathlib import Path

from pipeline.execution.stage import Executor, Progress
from pipeline.readers import inspect_scan
from pipeline.readers.attributes.options import ReadOptions
from pipeline.readers.check import Finding, check_scan
from pipeline.volumes.inspect import check_volume, inspect_volume
from pipeline.volumes.open import HANDLED, is_volume
from pipeline.volumes.volume import Choice
from storage.errors import InvalidScan, UnsupportedScan
from storage.packed.seal import names_packed_file


def inspect(path: Path, reading: ReadOptions = ReadOptions(), choice: Choice = Choice()) -> dict:
    """A JSON-able account of a scan, of a volume of which `choice` says what it leaves open, or of a packed file."""
    return inspect_packed(path) if names_packed_file(path) else inspect_input(path, reading, choice)


def inspect_input(path: Path, reading: ReadOptions = ReadOptions(), choice: Choice = Choice()) -> dict:
    """A JSON-able account of what `compress` takes: a scan, or a volume."""
    return inspect_volume(str(path), choice) if is_volume(path) else inspect_scan(str(path), reading)


def inspect_packed(path: Path) -> dict:
    """A packed file's header; its seal is checked, so a damaged file is refused."""
    from storage.packed.packed import PackedFile  # zarr takes half a second to import, and scans do without

    with PackedFile(path) as packed:
        header = packed.header.to_json()
    cameras = header.pop("cameras")
    return {**header, "kind": "packed", "file_bytes": path.stat().st_size, "cameras": [c["name"] for c in cameras]}


def check(path: Path, reading: ReadOptions = ReadOptions(), strict: bool = False, choice: Choice = Choice()) -> dict:
    """A JSON-able account of what is wrong with a scan; `ok` unless a finding is an error, or a warning if `strict`."""
    findings = _check_volume(path, choice) if is_volume(path) else check_scan(str(path), reading)
    return {
        "path": str(path),
        "ok": not {f.severity for f in findings} & ({"error", "warning"} if strict else {"error"}),
        "findings": [asdict(f) for f in findings],
    }


def _check_volume(path: Path, choice: Choice) -> list[Finding]:
    try:
        warnings, notes = check_volume(str(path), choice)
    except InvalidScan as error:
        return [Finding("error", str(error))]
    return [*(Finding("warning", text) for text in warnings), *(Finding("note", text) for text in notes)]


def iso_values(path: Path, choice: Choice, executor: Executor, progress: Progress, work: Path | None = None) -> dict:
    """A JSON-able account: `volume`, and what stage iso-values finds.

    Raises: UnsupportedScan for what is no volume, and what opening one raises.
    """
    from services.flow.points.volumes import iso_values_of
    from services.flow.run import Run  # stages take a second to import, and headers do without

    if not is_volume(path):
        raise UnsupportedScan(str(path), "no volume", HANDLED)
    with tempfile.TemporaryDirectory(prefix="splatpress-iso-") as scratch:
        if work:
            work.mkdir(parents=True, exist_ok=True)
        voxels, values = iso_values_of(Run(work or Path(scratch), executor, progress), path, choice)
        return {"volume": asdict(voxels.summary), **asdict(values.summary)}
