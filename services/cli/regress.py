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

from pipeline.planning.knobs import BY_NAME
from pipeline.planning.settings import DEFAULT_PRESET, settings_for
from services.cli.client import Client
from services.cli.parser import WrongArgument

TOLERANCE = {"texture_psnr_db": 0.05, "file_bytes": 0.01, "seconds": 0.5}
KEYS = ("name", "scan", "preset", "options", "seed", "expected", "tolerance")
REPORT = "report.json"


def regress(client: Client, path: Path, update: bool) -> list[dict]:
    """Run every job of a list; prints a table; returns a row a figure. With `update` the list gets what was measured.

    Raises: WrongArgument for a list that is none, before any job is submitted.
    """
    text = path.read_text()
    jobs = read_list(text, path)
    submitted = [_submit(client, job, path.parent) for job in jobs]
    measured = [_measure(client, id) for id in submitted]
    rows = [row for job, found in zip(jobs, measured, strict=True) for row in _compare(job, found)]
    print(_table(rows))
    if update:
        path.write_text(_updated(text, jobs, measured))
    return rows


def read_list(text: str, path: Path) -> list[dict]:
    """The jobs of a list. Raises WrongArgument naming the line and column of broken TOML, the job and its wrong key,
    or a list without a job: a gate that looks at nothing would pass for ever."""
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise WrongArgument(f"{path}: {error}") from None
    jobs = document.get("job", [])
    _check_keys(document, ("job",), f"{path}")
    if not (isinstance(jobs, list) and jobs and all(isinstance(job, dict) for job in jobs)):
        raise WrongArgument(f"{path}: no [[job]] in it; allowed: one or more")
    for number, job in enumerate(jobs, start=1):
        where = f"{path}: job {number}" + (f" ({job['name']})" if isinstance(job.get("name"), str) else "")
        _check_job(job, where, path.parent)
    return jobs


def _check_job(job: dict, where: str, base: Path) -> None:
    _check_keys(job, KEYS, where)
    if not isinstance(job.get("scan"), str):
        raise WrongArgument(f"{where}: no scan; allowed: a path below the list's folder")
    if not (base / job["scan"]).exists():
        raise WrongArgument(f"{where}: scan {base / job['scan']}: no such file or folder")
    for key, kind in (("preset", str), ("name", str), ("seed", int)):
        if not isinstance(job.get(key, kind()), kind):
            raise WrongArgument(f"{where}: {key} is {job[key]!r}; allowed: {kind.__name__}")
    for key, allowed in (("options", tuple(BY_NAME)), ("expected", tuple(TOLERANCE)), ("tolerance", tuple(TOLERANCE))):
        table = job.get(key, {})
        if not isinstance(table, dict):
            raise WrongArgument(f"{where}: {key} is {table!r}; allowed: a table")
        _check_keys(table, allowed, f"{where}: {key}")
        for name, value in table.items() if key != "options" else ():
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                raise WrongArgument(f"{where}: {key}.{name} is {value!r}; allowed: a number")
    try:
        settings_for(job.get("preset", DEFAULT_PRESET), **job.get("options", {}))
    except (ValueError, TypeError, KeyError) as error:
        raise WrongArgument(f"{where}: {error}") from None


def _check_keys(table: dict, allowed: tuple[str, ...], where: str) -> None:
    if unknown := [key for key in table if key not in allowed]:
        raise WrongArgument(f"{where}: {', '.join(map(repr, unknown))} is no key of it; allowed: {', '.join(allowed)}")


def _submit(client: Client, job: dict, base: Path) -> str:
    scan = base / job["scan"]
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
        "n_reused": sum(stage["reused"] for stage in report["stages"]),
    }


def _compare(job: dict, found: dict) -> list[dict]:
    """PSNR may be higher, bytes and seconds lower than expected: only a turn for the worse is a miss. Seconds of a job
    that took over stages of an earlier one say nothing, and are not compared."""
    name, rows = job.get("name", job["scan"]), []
    if found["status"] != "successful":
        return [{"job": name, "figure": "status", "expected": "successful", "measured": found["status"], "ok": False}]
    for figure, expected in job.get("expected", {}).items():
        tolerance, measured = job.get("tolerance", {}).get(figure, TOLERANCE[figure]), found[figure]
        if figure == "seconds" and found["n_reused"]:
            measured, ok = f"not compared: {found['n_reused']} stages were there already", True
        elif figure == "texture_psnr_db":
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


def _updated(text: str, jobs: list[dict], measured: list[dict]) -> str:
    """The list with new `expected` lines, all else as it was, comments too; seconds stay where stages were reused."""
    parts = re.split(r"(?m)^(?=\[\[job\]\])", text)
    for i, (job, found) in enumerate(zip(jobs, measured, strict=True), start=len(parts) - len(measured)):
        figures = {name: found[name] for name in TOLERANCE if found.get(name) is not None}
        if found.get("n_reused"):
            old_seconds = job.get("expected", {}).get("seconds")
            figures = {n: v for n, v in (figures | {"seconds": old_seconds}).items() if v is not None}
        line = "expected = { " + ", ".join(f"{name} = {round(value, 3)}" for name, value in figures.items()) + " }"
        old = re.compile(r"(?m)^expected *=.*$")
        parts[i] = old.sub(line, parts[i]) if old.search(parts[i]) else parts[i].rstrip("\n") + f"\n{line}\n"
    return "".join(parts)
