"""Rows of the store as the API shows them."""

from __future__ import annotations

from datetime import UTC, datetime

from services.settings import ServiceSettings
from services.store.rows import LIVE, ArtifactRow, JobRow, ScanRow, UploadRow


def timestamp(seconds: float | None) -> str | None:
    """Seconds since 1970 as RFC 3339 in UTC, to a millisecond; None of None."""
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds")


def expires(job: JobRow, settings: ServiceSettings) -> str | None:
    """None while it runs, and where it is pinned."""
    if job.pinned or job.status in LIVE or job.finished is None:
        return None
    return timestamp(job.finished + settings.retention_s)


def job_document(job: JobRow, settings: ServiceSettings) -> dict:
    """OGC API - Processes, statusInfo, and what this service adds."""
    return {
        "jobID": job.id,
        "type": "process",
        "processID": job.process,
        "status": job.status,
        "progress": job.progress,
        "message": job.message or "",
        "created": timestamp(job.created),
        "started": timestamp(job.started),
        "finished": timestamp(job.finished),
        "updated": timestamp(job.updated),
        "name": job.name,
        "scan": job.scan,
        "settings": job.settings,
        "attempt": job.attempt,
        "stage": job.stage,
        "live": job.live,
        "problem": job.problem,
        "pinned": job.pinned,
        "expires_at": expires(job, settings),
        "links": [
            {"rel": rel, "href": f"/v1/jobs/{job.id}{tail}"}
            for rel, tail in (
                ("self", ""),
                ("events", "/events"),
                ("logs", "/logs"),
                ("results", "/artifacts"),
                ("archive", "/archive"),
                ("http://www.opengis.net/def/rel/ogc/1.0/results", "/results"),
            )
        ],
    }


def scan_document(scan: ScanRow, settings: ServiceSettings) -> dict:
    """Its headers' account; bounds that they lack and `effects`, the plan with what decided, once a job has measured
    them."""
    header = scan.header
    return {
        "id": scan.id,
        "file": scan.file,
        "bytes": scan.bytes,
        "created": timestamp(scan.created),
        "expires_at": timestamp(scan.created + settings.retention_s),
        "effects": None,
        **header,
        "calls_for": calls_for(header),
    }


def calls_for(header: dict) -> list[str]:
    """Which parts of the pipeline a scan will make use of, and why."""
    if header.get("kind") == "volume":
        return ["surfaces of the iso values that a job names, or of the one that its histogram proposes first"]
    if not header["cameras"]["count"]:
        wanted = ["colours alone: there are no photographs"]
    elif header["has_visibility"]:
        wanted = ["textures, with cameras from its visibility lists"]
    else:
        wanted = ["textures, with cameras found by a depth test: there are no visibility lists"]
    return wanted + ([] if header["has_normals"] else ["normals estimated from neighbours: it has none"])


def artifact_document(artifact: ArtifactRow, job: JobRow, settings: ServiceSettings) -> dict:
    """An artifact as the API shows it."""
    return {
        "name": artifact.name,
        "bytes": artifact.bytes,
        "sha256": artifact.sha256,
        "expires_at": expires(job, settings),
        "href": f"/v1/jobs/{job.id}/artifacts/{artifact.name}",
    }


def upload_document(upload: UploadRow, offset: int) -> dict:
    """An upload as the API shows it, of which `offset` bytes have arrived."""
    return {
        "id": upload.id,
        "file": upload.file,
        "length": upload.length,
        "offset": offset,
        "expires_at": timestamp(upload.expires),
        "scan": upload.scan,
        "problem": upload.problem,
    }
