"""/healthz, /readyz, /metrics."""

from __future__ import annotations

import shutil
import time

from fastapi import APIRouter
from fastapi.responses import JSONResponse, PlainTextResponse

from services.api.context import Database, Owner, Settings
from services.jobs.heartbeat import runner_age_s
from storage.version import VERSION

router = APIRouter(tags=["health"])
RUNNER_AGE_S = 30.0


@router.get("/healthz")
def get_healthz() -> dict:
    """This process answers, of this version."""
    return {"status": "ok", "version": VERSION}


@router.get("/readyz", responses={503: {"description": "not yet"}})
def get_readyz(settings: Settings, store: Database) -> JSONResponse:
    """The database answers, the disk has room, and the runner is alive."""
    age = runner_age_s(settings.place)
    checks = {
        "database": _answers(store),
        "disk": shutil.disk_usage(settings.data).free > settings.reserve_bytes,
        "runner": age is not None and age < RUNNER_AGE_S,
    }
    ready = all(checks.values())
    return JSONResponse({"status": "ready" if ready else "not ready", "checks": checks}, 200 if ready else 503)


def _answers(store) -> bool:
    try:
        store.figures()
        return True
    except Exception:
        return False


@router.get("/metrics", response_class=PlainTextResponse)
def get_metrics(owner: Owner, settings: Settings, store: Database) -> PlainTextResponse:
    """Prometheus text."""
    figures = store.figures()
    lines = [
        "# TYPE splatpress_jobs gauge",
        *(f'splatpress_jobs{{status="{s}"}} {n}' for s, n in figures.jobs.items()),
    ]
    for name, key in (
        ("stage_seconds_total", "seconds"),
        ("stage_runs_total", "runs"),
        ("stage_splats_total", "splats"),
    ):
        lines.append(f"# TYPE splatpress_{name} counter")
        lines += [f'splatpress_{name}{{stage="{row.stage}"}} {getattr(row, key)}' for row in figures.stages]
    coded = sum(row.splats for row in figures.stages if row.stage == "encode")
    lines += ["# TYPE splatpress_splats_coded_total counter", f"splatpress_splats_coded_total {coded}"]
    for kind, n_bytes in (("scan", figures.scan_bytes), ("artifact", figures.artifact_bytes)):
        lines += [f"# TYPE splatpress_{kind}_bytes gauge", f"splatpress_{kind}_bytes {n_bytes}"]
    lines += [
        "# TYPE splatpress_disk_free_bytes gauge",
        f"splatpress_disk_free_bytes {shutil.disk_usage(settings.data).free}",
        "# TYPE splatpress_time_seconds gauge",
        f"splatpress_time_seconds {time.time():.0f}",
    ]
    return PlainTextResponse("\n".join(lines) + "\n", media_type="text/plain; version=0.0.4")
