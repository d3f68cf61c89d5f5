"""Is what `splatpress estimate` says what then happens?

    python -m benchmarks.estimates SCAN... [--preset draft balanced high] [--set KNOB=VALUE] [--workers 2] [--stages]
    [--json]

Each scan is estimated with each preset and then compressed, without pictures, in one work folder, as the service does:
up to the splats and their effects a job takes over what its estimate made. Ratios are estimate / happened, so 1.10 says
a tenth too much. Wall seconds mean something only where the machine's load stays what it was between the two, so
seconds of the coder's tasks are compared as the processor counted them too (`cpu`): of the stages that only the job ran
to the end.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path

from msgspec import to_builtins

from benchmarks.patches import Silent
from pipeline.execution.executors import DaskExecutor, SerialExecutor
from pipeline.planning.knobs import BY_NAME
from pipeline.planning.settings import PRESETS, Settings, settings_for
from renderer.evaluate.close_ups import Variant
from renderer.evaluate.picture_psnr import picture_psnrs
from services.flow.asked import prepare_asked
from services.flow.run import Run
from services.processes.compress import compress
from services.processes.estimate import estimate
from storage.packed.packed import SUFFIX
from storage.work import work

BARS = {"seconds": 0.25, "bytes": 0.05, "psnr_db": 0.5, "picture_db": 0.5}


def compare(scan: Path, settings: Settings, n_workers: int) -> dict:
    """One estimate and the job after it."""
    with tempfile.TemporaryDirectory() as folder:
        kept = Path(folder) / "work"
        kept.mkdir()
        begun, used = time.perf_counter(), _processor_s()
        with _executor(n_workers) as executor:
            found = to_builtins(estimate(scan, settings, executor, Silent(), kept))
        pilot_s, pilot_cpu_s = time.perf_counter() - begun, _processor_s() - used
        with _executor(n_workers) as executor:
            out = Path(folder) / "out"
            report = compress(scan, out, settings, executor, Silent(), render=False, work=kept)
            prepared = prepare_asked(Run(kept, executor, Silent()), scan, settings)
            [packed] = out.glob(f"*{SUFFIX}")
            [picture] = picture_psnrs([Variant("job", packed)], prepared.photos) if psnr_of(found) else [None]
            file_bytes = packed.stat().st_size
        stages = _stages(found, report, kept)
    coder = [row for row in stages if not row["reused"]]
    happened = {name: figure["happened"] for name, figure in report["estimate"].items()}
    psnr, drawn = found["texture_psnr_db"], found["picture_psnr_db"]
    return {
        "scan": scan.name,
        "preset": settings.preset,
        "splats": report["splats"],
        "pilot_seconds": pilot_s,
        "pilot_cpu_seconds": pilot_cpu_s,
        "estimated": {name: found[name]["value"] for name in happened},
        "happened": happened,
        "ratios": {
            "seconds": found["seconds"]["value"] / happened["seconds"],
            "cpu": _ratio(coder, "cpu_estimated", "cpu_happened"),
            "bytes": found["gpu_bytes"]["value"] / happened["gpu_bytes"],
            "memory": found["peak_memory_bytes"]["value"] / happened["peak_memory_bytes"],
        },
        "file": [found["file_bytes"]["value"], file_bytes],
        "picture": [drawn["value"], picture] if drawn else None,
        "psnr_off_db": psnr["value"] - happened["texture_psnr_db"] if psnr else None,
        "sizes": {
            part: [found["sizes"][part], report["sizes"][part]]
            for part in ("geometry_bytes", "codes_bytes", "colors_bytes", "dictionary_bytes")
        },
        "stages": stages,
    }


def psnr_of(found: dict) -> bool:
    """Whether photographs tell what the estimate is worth."""
    return found["picture_psnr_db"] is not None


def _executor(n_workers: int):
    return DaskExecutor(n_workers) if n_workers > 1 else SerialExecutor()


def _processor_s() -> float:
    """Of this process and of its workers that have ended, starting them among it."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


def _stages(found: dict, report: dict, kept: Path) -> list[dict]:
    estimated = {row["name"]: row for row in found["stages"]}
    rows = []
    for stage in report["stages"]:
        name = stage["name"]
        tasks = [t for made in kept.glob(f"{name}-????????????????") for t in work.finished_tasks(made).values()]
        of = estimated.get(name, {"seconds": 0.0, "processor_seconds": 0.0})
        rows.append(
            {
                "name": name,
                "reused": stage["reused"],
                "estimated": of["seconds"],
                "happened": of["seconds"] if stage["reused"] else stage["seconds"],
                "cpu_estimated": of.get("processor_seconds", 0.0),
                "cpu_happened": sum(t.processor_seconds for t in tasks),
            }
        )
    return rows


def _ratio(rows: list[dict], a: str, b: str) -> float:
    return sum(row[a] for row in rows) / max(1e-9, sum(row[b] for row in rows))


def show(row: dict, stages: bool) -> None:
    ratios, off = row["ratios"], row["psnr_off_db"]
    print(
        f"{row['scan']:<22}{row['preset']:<10}{row['splats']:>9,}  pilot {row['pilot_seconds']:5.1f} s, cpu {row['pilot_cpu_seconds']:5.1f} s  job {row['happened']['seconds']:6.1f} s  "
        f"seconds {ratios['seconds']:.2f}  cpu {ratios['cpu']:.2f}  bytes {ratios['bytes']:.3f}  memory {ratios['memory']:.2f}  "
        + f"file {row['file'][0] / row['file'][1]:.3f}  "
        + (f"PSNR {off:+.2f} dB" if off is not None else "no photographs")
        + (f"  pictures {row['picture'][0]:.2f} for {row['picture'][1]:.2f} dB" if row["picture"] else ""),
        flush=True,
    )
    if stages:
        for s in row["stages"]:
            print(
                f"    {s['name'] + (' *' if s['reused'] else ''):<18}{s['estimated']:7.2f} for {s['happened']:7.2f} s, processor {s['cpu_estimated']:7.2f} for {s['cpu_happened']:7.2f} s"
            )
        for part, (a, b) in row["sizes"].items():
            print(f"    {part:<18}{a:>12,} for {b:>12,}  {a / b if b else 0:.3f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", type=Path, nargs="+", metavar="SCAN")
    parser.add_argument("--preset", nargs="+", default=list(PRESETS), choices=list(PRESETS))
    parser.add_argument(
        "--set", action="append", default=[], metavar="KNOB=VALUE", help="over each preset; may be repeated"
    )
    parser.add_argument("--workers", type=int, default=2, help="1: all in this process")
    parser.add_argument("--stages", action="store_true", help="stage by stage, part by part")
    parser.add_argument("--json", action="store_true", help="all of it, a line each")
    options = parser.parse_args()
    changes = {name: BY_NAME[name].parsed(text) for name, _, text in (pair.partition("=") for pair in options.set)}
    for scan in options.scans:
        for preset in options.preset:
            row = compare(scan, settings_for(preset, **changes), options.workers)
            print(json.dumps(row), flush=True) if options.json else show(row, options.stages)


if __name__ == "__main__":
    main()
