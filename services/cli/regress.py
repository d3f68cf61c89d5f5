"""A list of jobs with what is expected of them, run on a service: the scripted regression job.

[[job]]
name = "fountain, draft"
scan = "../shared/data/fountain_p11"     # below this file's folder
preset = "draft"
options = { iterations = 2 }
expected = { texture_psnr_db = 36.01, file_bytes = 12345678, seconds = 60.0 }
tolerance = { texture_psnr_db = 0.05, file_bytes = 0.01, seconds = 0.5 }   # dB; shares of what is expected
"""

from __future__ import annotations

import json
import re
import tempfile
import tomllib
from pathlib import Path

from services.cli.client import Client

TOLERANCE = {"texture_psnr_db": 0.05, "file_bytes": 0.01, "seconds": 0.5}
REPORT = "report.json"


def regress(client: Client, path: Path, update: bool) -> list[dict]:
    """Run every job of a list; prints a table; returns a row a figure. With `update` the list gets what was
    measured."""
    text = path.read_text()
    jobs = tomllib.loads(text).get("job", [])
    submitted = [_submit(client, job, path.parent) for job in jobs]
    measured = [_measure(client, id) for id in submitted]
    rows = [row for job, found in zip(jobs, measured, strict=True) for row in _compare(job, found)]
    print(_table(rows))
    if update:
        path.write_text(_updated(text, measured))
    return rows


def _submit(client: Client, job: dict, base: Path) -> str:
    scan = base / job["scan"]
    if not scan.exists():
        raise FileNotFoundError(f"{scan}: no such file or folder")
    request = {name: job[name] for name in ("preset", "options", "seed", "name") if name in job}
    return client.submit(client.upload(scan)["id"], **request)["jobID"]


def _measure(client: Client, id: str) -> dict:
    job = client.watch(id, lambda event: None)
    if job["status"] != "successful":
        return {"status": job["status"]}
    with tempfile.TemporaryDirectory() as folder:
        client.fetch(id, Path(folder), [REPORT])
        report = json.loads((Path(folder) / REPORT).read_text())
    return {
        "status": job["status"],
        "texture_psnr_db": report["quality"]["texture_psnr_db"],
        "file_bytes": report["sizes"]["file_bytes"],
        "seconds": sum(stage["seconds"] for stage in report["stages"]),
    }


def _compare(job: dict, found: dict) -> list[dict]:
    """PSNR may be higher, bytes and seconds lower than expected: only a turn for the worse is a miss."""
    name, rows = job.get("name", job["scan"]), []
    if found["status"] != "successful":
        return [{"job": name, "figure": "status", "expected": "successful", "measured": found["status"], "ok": False}]
    for figure, expected in job.get("expected", {}).items():
        tolerance, measured = job.get("tolerance", {}).get(figure, TOLERANCE[figure]), found[figure]
        if figure == "texture_psnr_db":
            ok = measured is not None and measured >= expected - tolerance
        else:
            ok = measured <= expected * (1 + tolerance)
        rows.append({"job": name, "figure": figure, "expected": expected, "measured": measured, "ok": ok})
    return rows or [{"job": name, "figure": "status", "expected": "successful", "measured": "successful", "ok": True}]


def _table(rows: list[dict]) -> str:
    cells = [("job", "figure", "expected", "measured", "")]
    cells += [
        (r["job"], r["figure"], _shown(r["expected"]), _shown(r["measured"]), "ok" if r["ok"] else "MISSED")
        for r in rows
    ]
    widths = [max(len(row[i]) for row in cells) for i in range(5)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in cells
    )


def _shown(value) -> str:
    return f"{value:,.2f}" if isinstance(value, float) else f"{value:,}" if isinstance(value, int) else str(value)


def _updated(text: str, measured: list[dict]) -> str:
    """The list with new `expected` lines, all else as it was, comments too."""
    parts = re.split(r"(?m)^(?=\[\[job\]\])", text)
    for i, found in enumerate(measured, start=len(parts) - len(measured)):
        figures = {name: found[name] for name in TOLERANCE if found.get(name) is not None}
        line = "expected = { " + ", ".join(f"{name} = {round(value, 3)}" for name, value in figures.items()) + " }"
        old = re.compile(r"(?m)^expected *=.*$")
        parts[i] = old.sub(line, parts[i]) if old.search(parts[i]) else parts[i].rstrip("\n") + f"\n{line}\n"
    return "".join(parts)
