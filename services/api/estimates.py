"""/v1/jobs/estimate: what a job would take, from a pilot run in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Query, Request
from msgspec import to_builtins

from pipeline.planning.knobs import BY_NAME
from pipeline.planning.settings import DEFAULT_PRESET, PRESETS, settings_for
from services.api.context import Database, Owner, Settings
from services.flow.estimate_cache import FOLDER as ESTIMATES
from services.flow.estimate_cache import known_estimate
from services.problems import RESOURCE, Problem
from services.uploads.scans import scan_path, work_folder
from storage import place

router = APIRouter(tags=["jobs"])
PILOT_S = 300.0
_one_pilot = threading.Lock()  # it takes all cores for seconds
_ROOT = Path(__file__).resolve().parent.parent.parent


@router.get("/jobs/estimate")
def get_estimate(
    request: Request,
    owner: Owner,
    settings: Settings,
    store: Database,
    scan: Annotated[str, Query(pattern="^[0-9a-f]{64}$")],
    preset: Annotated[str, Query(max_length=40)] = DEFAULT_PRESET,
) -> dict:
    """Seconds, peak memory, bytes and PSNR, each with a band. Further query parameters are options by name, as
    `target_psnr_db=42`. What was estimated before is answered at once; else a pilot runs, one at a time."""
    found = store.scan(scan, owner)
    if found is None:
        raise Problem(422, "no-such-scan", f"no scan {scan}")
    options = {k: v for k, v in request.query_params.items() if k not in ("scan", "preset")}
    wanted = _settings(preset, options)
    folder = work_folder(settings, scan)
    known = known_estimate(folder, wanted)
    if known is not None:
        return to_builtins(known)
    own = settings.data / "work" / scan  # where a bucket has the work folders, the pilot has one of its own
    own.mkdir(parents=True, exist_ok=True)
    made = _pilot(place.held(scan_path(settings, found)), own, preset, options)
    place.put_folder(own / ESTIMATES, folder / ESTIMATES)
    return made


def _settings(preset: str, options: dict[str, str]):
    try:
        if preset not in PRESETS:
            raise ValueError(f"preset is {preset!r}; allowed: {', '.join(PRESETS)}")
        for name in options:
            if name not in BY_NAME:
                raise ValueError(f"{name!r} is no option; allowed: {', '.join(BY_NAME)}")
        return settings_for(preset, **{name: BY_NAME[name].parsed(text) for name, text in options.items()})
    except ValueError as error:
        raise Problem(422, "invalid-option", str(error)) from None


def _pilot(scan: Path, folder: Path, preset: str, options: dict[str, str]) -> dict:
    if not _one_pilot.acquire(blocking=False):
        raise Problem(
            429,
            "pilot-running",
            "another estimate is being made",
            kind=RESOURCE,
            retryable=True,
            headers={"Retry-After": "15"},
        )
    try:
        arguments = [f"--{name.replace('_', '-')}={text}" for name, text in options.items()]
        child = subprocess.run(
            [
                sys.executable,
                "-m",
                "services.cli",
                "estimate",
                str(scan.resolve()),
                "--preset",
                preset,
                "--work",
                str(folder.resolve()),
                "--json",
                *arguments,
            ],
            capture_output=True,
            text=True,
            timeout=PILOT_S,
            cwd=_ROOT,
        )
    except subprocess.TimeoutExpired:
        raise Problem(
            503, "pilot-too-slow", f"the pilot took longer than {PILOT_S:g} s", kind=RESOURCE, retryable=True
        ) from None
    finally:
        _one_pilot.release()
    if child.returncode != 0:
        said = (child.stderr.strip().splitlines() or ["it said nothing"])[-1].replace(str(scan.parent) + "/", "")
        raise Problem(
            422 if child.returncode == 3 else 500,
            "no-estimate",
            said,
            kind="data" if child.returncode == 3 else "internal",
        )
    return json.loads(child.stdout.splitlines()[-1])
