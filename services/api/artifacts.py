"""/v1/jobs/{id}/artifacts: what a job made, whole or in ranges."""

from __future__ import annotations

from fastapi import APIRouter
from fastapi.responses import FileResponse

from services.api.context import Database, Job, Settings
from services.jobs.documents import artifact_document
from services.jobs.workflow import job_folder
from services.problems import Problem
from services.store.store import LIVE

router = APIRouter(tags=["artifacts"])
# A report is a page of ours that names things a stranger chose: it may run its plots, and reach nothing else.
_PAGE = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval'; style-src 'unsafe-inline'; "
    "img-src 'self' data:; frame-ancestors 'self'"
)


@router.get("/jobs/{id}/artifacts")
def get_artifacts(job: Job, settings: Settings, store: Database) -> dict:
    """Of a failed or dismissed job, those that it had made by then."""
    return {"artifacts": [artifact_document(a, job, settings) for a in store.artifacts(job["id"])]}


@router.get(
    "/jobs/{id}/artifacts/{name:path}",
    response_class=FileResponse,
    responses={200: {"content": {"application/octet-stream": {}}, "description": "the file, or a range of it"}},
)
def get_artifact(job: Job, name: str, settings: Settings, store: Database) -> FileResponse:
    artifact = store.artifact(job["id"], name) if len(name) <= 300 and name.isprintable() else None
    if artifact is None:
        early = job["status"] in LIVE
        raise Problem(
            404,
            "result-not-ready" if early else "no-such-artifact",
            f"job {job['id']} has no {name!r}" + (f" yet: it is {job['status']}" if early else ""),
            retryable=early,
        )
    path = job_folder(settings, job["id"]) / artifact["path"]
    if not path.is_file():
        raise Problem(410, "expired", f"{name} has expired")
    headers = {"etag": f'"{artifact["sha256"]}"', "cache-control": "private, max-age=0, must-revalidate"}
    if path.suffix == ".html":
        headers["content-security-policy"] = _PAGE
    return FileResponse(path, headers=headers)
