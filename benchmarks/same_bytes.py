"""Whether two checkouts of the program make the same of a scan, and how much longer one takes: for changes that move
code and are to change no byte.

    python -m benchmarks.same_bytes OLD NEW SCAN... [--preset draft --preset balanced] [--pairs 1]

OLD and NEW are folders with the code. Each scan is compressed by either in turn, one task after the other, with each
preset; a row says whether the packed files, the previews and the reports without their times are equal, and what NEW
took of a processor, its start included, for 1 s of OLD: the median over the pairs.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

TIMES = {"seconds", "baseline_seconds", "peak_rss_bytes", "splats_per_second", "device"}


def without_times(told: Any) -> Any:
    """A report without what no two runs have in common."""
    if isinstance(told, dict):
        return {name: without_times(value) for name, value in told.items() if name not in TIMES}
    return [without_times(value) for value in told] if isinstance(told, list) else told


def differences(a: Any, b: Any, where: str = "") -> list[str]:
    """Where two documents differ."""
    if isinstance(a, dict) and isinstance(b, dict):
        return [
            d for name in sorted(a.keys() | b.keys()) for d in differences(a.get(name), b.get(name), f"{where}/{name}")
        ]
    if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        return [d for i, (x, y) in enumerate(zip(a, b, strict=True)) for d in differences(x, y, f"{where}/{i}")]
    return [] if a == b else [where]


def compressed(code: Path, scan: Path, preset: str, out: Path) -> tuple[str, str, Any, float]:
    """SHA-256 of the packed file and of the previews, the report without times, and seconds of a processor."""
    used = _processor_seconds()
    command = [sys.executable, "-m", "services.cli", "compress", str(scan), "--out", str(out), "--preset", preset]
    environment = os.environ | {"PYTHONPATH": str(code)}
    subprocess.run([*command, "--executor", "serial"], cwd=code, env=environment, check=True, capture_output=True)
    taken = _processor_seconds() - used
    found = _hash([*out.glob("*.splatpress")]), _hash(sorted((out / "previews").glob("*.png")))
    report = without_times(json.loads((out / "report.json").read_text()))
    shutil.rmtree(out)
    return *found, report, taken


def _hash(paths: list[Path]) -> str:
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()


def _processor_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("scans", type=Path, nargs="+", metavar="SCAN")
    parser.add_argument("--preset", action="append")
    parser.add_argument("--pairs", type=int, default=1)
    options = parser.parse_args()
    n_different = 0
    with tempfile.TemporaryDirectory() as folder:
        for scan in options.scans:
            for preset in options.preset or ["draft", "balanced"]:
                pairs = [
                    [compressed(code.resolve(), scan.resolve(), preset, Path(folder) / "out") for code in (options.old, options.new)]
                    for _ in range(options.pairs)
                ]  # fmt: skip
                (packed, pictures, report, _), (packed_now, pictures_now, report_now, _) = pairs[0]
                ratio = statistics.median(new[3] / old[3] for old, new in pairs)
                told = differences(report, report_now)
                n_different += (packed != packed_now) + (pictures != pictures_now) + bool(told)
                print(
                    f"{scan.name} {preset}: packed {'equal' if packed == packed_now else 'DIFFERENT'}, "
                    f"previews {'equal' if pictures == pictures_now else 'DIFFERENT'}, "
                    f"report {'equal but for times' if not told else 'DIFFERENT at ' + ', '.join(told)}; "
                    f"{ratio:.3f} of the processor's seconds",
                    flush=True,
                )
    return min(1, n_different)


if __name__ == "__main__":
    sys.exit(main())
