"""The scans that `demo` compresses: all that `compress` takes, of each kind one, without a download."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from services.processes.demo.laser import write_laser_scan
from services.processes.demo.motorcycle import write_motorcycle
from services.processes.demo.volume import ISO, write_volume


@dataclass(frozen=True)
class DemoScan:
    """How a scan is made, where it and its packed file go, and which surface of it is asked for."""

    write: Callable[[Path], Path]  # into a folder; returns the scan's path
    out: str
    scan: str  # its name beside the packed file
    iso: str = ""  # of a volume


SCANS = {
    "motorcycle": DemoScan(lambda folder: write_motorcycle(folder / "motorcycle"), "demo-output", "scan"),
    "points": DemoScan(write_laser_scan, "demo-output-points", "scan.las"),
    "volume": DemoScan(write_volume, "demo-output-volume", "scan.nrrd", f"{ISO}"),
}
