"""/v1/jobs/{id}/artifacts: what a job made, whole or in ranges."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import quote

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import FileResponse, StreamingResponse

from pipeline.exports.formats import FORMATS
from services.api.context import Database, Job, Settings
from services.files import SentFile, is_known
from services.jobs.archive import zipped
from services.jobs.documents import artifact_document
from services.jobs.workflow import job_folder
from services.problems import Problem
from services.store.exports import export_name, packed_artifact, want_export
from services.store.rows import LIVE, JobRow
from services.uploads.scans import safe_name
from storage import place

router = APIRouter(tags=["artifacts"])
# A report is a page of ours that names things a stranger chose: it may run its plots, and reach nothing else.
_PAGE = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob:; style-src 'unsafe-inline'; "
    "img-src 'self' data:; frame-ancestors 'self'"
)


_RETRY_S = "1"


@router.get("/jobs/{id}/artifacts", responses={202: {"description": "a format that is being made: ask again"}})
def get_artifacts(
    job: Job,
    settings: Settings,
    store: Database,
    response: Response,
    format: Annotated[Literal[*FORMATS] | None, Query(description="the packed file as what others open")] = None,  # type: ignore[valid-type]
) -> dict:
    """Of a failed or dismissed job, those that it had made by then. With `format` that one alone, made by a worker
    where it is not there yet: 202 until it is, then it is kept as an artifact."""
    if format is None:
        return {"artifacts": [artifact_document(a, job, settings) for a in store.artifacts(job.id)]}
    packed = packed_artifact(store, job.id)
    if packed is None:
        raise _absent(job, "packed file", " to make it of")
    found = store.artifact(job.id, export_name(packed, format))
    if found is not None:
        return {"artifacts": [artifact_document(found, job, settings)]}
    if job.status in LIVE:
        raise _absent(job, format)
    problem = want_export(store, job.id, format)
    if problem is not None:
        raise Problem(
            problem["status"], "export-failed", problem["detail"], kind=problem["class"], retryable=problem["retryable"]
        )
    response.status_code = 202
    response.headers["Retry-After"] = _RETRY_S
    return {"artifacts": []}


@router.get(
    "/jobs/{id}/archive",
    response_class=StreamingResponse,
    responses={200: {"content": {"application/zip": {}}, "description": "a .zip of all artifacts, made as it is sent"}},
)
def get_archive(job: Job, settings: Settings, store: Database) -> StreamingResponse:
    """Everything that a job made, in one file."""
    rows = store.artifacts(job.id)
    if not rows:
        raise _absent(job, "artifact")
    folder = job_folder(settings, job.id)
    name = safe_name(job.name + ".zip")
    headers = {"content-disposition": f"attachment; filename*=UTF-8''{quote(name)}"}
    files = [(row.name, folder / row.path) for row in rows]
    return StreamingResponse(zipped(files), media_type="application/zip", headers=headers)


_FILE = {
    200: {"content": {"application/octet-stream": {}}, "description": "the file"},
    206: {"content": {"application/octet-stream": {}}, "description": "a range of it"},
    304: {"description": "it is still what If-None-Match names"},
}


@router.head("/jobs/{id}/artifacts/{name:path}", response_class=FileResponse, responses=_FILE)  # type: ignore[arg-type]
@router.get("/jobs/{id}/artifacts/{name:path}", response_class=FileResponse, responses=_FILE)  # type: ignore[arg-type]
def get_artifact(job: Job, name: str, settings: Settings, store: Database, request: Request) -> Response:
    """An artifact of a job, whole or in ranges; 304 where the caller has it already."""
    artifact = store.artifact(job.id, name) if len(name) <= 300 and name.isprintable() else None
    if artifact is None:
        raise _absent(job, repr(name))
    headers = {"etag": f'"{artifact.sha256}"', "cache-control": "private, max-age=0, must-revalidate"}
    if is_known(request, headers["etag"]):
        return Response(status_code=304, headers=headers)
    try:
        path = place.here(job_folder(settings, job.id) / artifact.path)
    except FileNotFoundError:
        path = Path()
    if not path.is_file():
        raise Problem(410, "expired", f"{name} has expired")
    if path.suffix == ".html":
        headers["content-security-policy"] = _PAGE
    return SentFile(path, headers=headers)


def _absent(job: JobRow, what: str, tail: str = "") -> Problem:
    early = job.status in LIVE
    return Problem(
        404,
        "result-not-ready" if early else "no-such-artifact",
        f"job {job.id} has no {what}{tail}" + (f" yet: it is {job.status}" if early else ""),
        retryable=early,
    )
