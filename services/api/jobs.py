"""/v1/jobs: submit, list, look, dismiss, try again, pin, read the log."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal, Union

from fastapi import APIRouter, Header, Query, Response
from pydantic import BaseModel, ConfigDict, Field, create_model

from pipeline.planning.knobs import KNOBS
from pipeline.planning.settings import DEFAULT_PRESET, PRESETS, settings_for
from services.api.context import Database, Job, Owner, Settings
from services.jobs.documents import job_document, timestamp
from services.jobs.webhooks import RefusedAddress, check_url
from services.jobs.workflow import dismissal_token, job_folder
from services.problems import RESOURCE, Problem
from services.processes.kinds import BUDGET_S, COMPRESS, PROCESSES, TRADEOFF, check_knobs
from services.store.rows import DISMISSED, FAILED, LEVELS, LIVE, STATES, SUCCESSFUL, NewJob
from services.store.store import KeyReused, TooManyJobs
from storage import place

router = APIRouter(tags=["jobs"])
Offset = Annotated[int, Query(ge=0, le=1 << 31)]
IdempotencyKey = Annotated[str | None, Header(pattern=r"^[\x21-\x7e]{1,255}$")]


# What a preset is changed by; `GET /v1/options` says what each allows.
JobOptions = create_model(  # type: ignore[call-overload]
    "JobOptions",
    __config__=ConfigDict(extra="forbid", strict=True),
    **{knob.name: (Union[*knob.kinds, None], None) for knob in KNOBS if knob.name != "seed"},
)


class JobRequest(BaseModel):
    """What a job is asked for with."""

    model_config = ConfigDict(extra="forbid")

    scan: str = Field(pattern="^[0-9a-f]{64}$")
    process: Literal[*PROCESSES] = COMPRESS  # type: ignore[valid-type]
    preset: Literal[*PRESETS] = DEFAULT_PRESET  # type: ignore[valid-type]
    options: JobOptions = JobOptions()  # type: ignore[valid-type]
    seed: int = Field(0, ge=0, lt=2**63)
    knobs: dict[str, Annotated[list[int | float | str], Field(max_length=20)]] | None = Field(
        None, max_length=len(KNOBS)
    )
    budget_s: float = Field(BUDGET_S, gt=0, le=86_400)
    name: str = Field("", max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$")
    webhook: str | None = Field(None, max_length=2000, pattern=r"^[\x21-\x7e]+$")


class JobChange(BaseModel):
    """What its owner may change of a job at any time."""

    model_config = ConfigDict(extra="forbid")

    pinned: bool | None = None
    name: str | None = Field(None, min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$")


@router.post("/jobs", status_code=201)
def post_job(
    request: JobRequest,
    response: Response,
    owner: Owner,
    settings: Settings,
    store: Database,
    idempotency_key: IdempotencyKey = None,
) -> dict:
    """Submit a job. The same Idempotency-Key with the same request gives the same job, with another request 422."""
    scan = store.scan(request.scan, owner)
    if scan is None:
        raise Problem(
            422, "no-such-scan", f"no scan {request.scan}", hint="upload it first; its id is the answer's `id`"
        )
    tradeoff = request.process == TRADEOFF
    row = NewJob(
        owner=owner,
        scan=scan.id,
        name=request.name or Path(scan.file).stem,
        settings=_settings(request),
        process=request.process,
        knobs=request.knobs,
        budget_s=request.budget_s if tradeoff else None,
        webhook=_webhook(request, settings),
        request_key=idempotency_key,
        request_hash=_hash(request),
    )
    try:
        job, new = store.add_job(row, settings.max_jobs_in_flight)
    except KeyReused:
        raise Problem(422, "key-reused", "this Idempotency-Key came before with another request") from None
    except TooManyJobs:
        raise Problem(
            429,
            "too-many-jobs",
            f"{settings.max_jobs_in_flight} jobs in flight already",
            kind=RESOURCE,
            retryable=True,
            headers={"Retry-After": "60"},
        ) from None
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    if not new:
        response.headers["Idempotent-Replayed"] = "true"
    return job_document(job, settings)


def _settings(request: JobRequest) -> dict:
    try:
        settings = settings_for(request.preset, **request.options.model_dump(), seed=request.seed)  # type: ignore[attr-defined]
        check_knobs(request.process, request.knobs)
        return asdict(settings)
    except ValueError as error:
        raise Problem(422, "invalid-option", str(error)) from None


def _webhook(request: JobRequest, settings) -> str | None:
    try:
        if request.webhook is not None:
            check_url(request.webhook, settings.webhook_private)
    except (RefusedAddress, ValueError) as error:
        raise Problem(422, "refused-webhook", str(error)) from None
    return request.webhook


def _hash(request: JobRequest) -> str:
    return hashlib.sha256(json.dumps(request.model_dump(), sort_keys=True).encode()).hexdigest()


@router.get("/jobs")
def get_jobs(
    owner: Owner,
    settings: Settings,
    store: Database,
    status: Literal[*STATES] | None = None,  # type: ignore[valid-type]
    scan: Annotated[str | None, Query(pattern="^[0-9a-f]{64}$")] = None,
    q: Annotated[str, Query(max_length=200, description="words that the name has, whatever their case")] = "",
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
    offset: Offset = 0,
) -> dict:
    """Newest first."""
    rows, n_matched = store.jobs(owner, limit, offset, status, scan, q)
    return {
        "jobs": [job_document(row, settings) for row in rows],
        "numberMatched": n_matched,
        "numberReturned": len(rows),
    }


@router.get("/jobs/{id}")
def get_job(job: Job, settings: Settings) -> dict:
    """A job's status, by OGC API - Processes, and what this service adds."""
    return job_document(job, settings)


@router.patch("/jobs/{id}")
def patch_job(job: Job, change: JobChange, settings: Settings, store: Database) -> dict:
    """Pin a job, and its artifacts do not expire; or give it another name."""
    store.change_job(job.id, **change.model_dump(exclude_none=True))
    return job_document(store.job(job.id), settings)


@router.delete("/jobs/{id}")
def delete_job(job: Job, settings: Settings, store: Database) -> dict:
    """Dismiss a job: one that runs stops, and what it made so far stays until it expires; one that has ended loses its
    artifacts, unless it is pinned (409). Again: 410."""
    if job.pinned and job.status in (SUCCESSFUL, FAILED):
        raise Problem(409, "pinned", f"job {job.id} is pinned", hint="unpin it first")
    was = store.dismiss(job.id)
    if was is None:
        raise Problem(410, "dismissed", f"job {job.id} was dismissed before")
    if was not in LIVE:
        place.remove_folder(job_folder(settings, job.id))
    place.touch(dismissal_token(settings, job.id, job.attempt))
    return job_document(store.job(job.id), settings)


@router.post("/jobs/{id}/retry", status_code=202)
def post_retry(job: Job, settings: Settings, store: Database) -> dict:
    """Go on from the stage that failed or was dismissed; log and creation date stay."""
    if not store.retry(job.id):
        raise Problem(409, "not-ended", f"job {job.id} is {store.job(job.id).status}; allowed: failed, {DISMISSED}")
    return job_document(store.job(job.id), settings)


@router.get("/jobs/{id}/logs")
def get_logs(
    job: Job,
    store: Database,
    offset: Offset = 0,
    level: Literal[*LEVELS] = "info",  # type: ignore[valid-type]
    limit: Annotated[int, Query(ge=1, le=1000)] = 200,
) -> dict:
    """Lines of `level` and above, oldest first."""
    rows = store.logs(job.id, offset, limit, level)
    return {
        "logs": [
            {"id": row.id, "time": timestamp(row.time), "level": row.level, "message": row.data["message"]}
            for row in rows
        ],
        "next_offset": offset + len(rows),
    }
