"""/v1/scans: small scans in one request, and what is known of a scan."""

from __future__ import annotations

import shutil
from typing import Annotated

from fastapi import APIRouter, File, Query, Response, UploadFile
from fastapi.concurrency import run_in_threadpool
from pydantic import BaseModel, ConfigDict, Field

from pipeline.effects.plan.measure_effects import known_rows
from services.api.context import Database, Hash, Owner, Settings
from services.jobs.documents import scan_document
from services.problems import Problem
from services.store.rows import ScanRow
from services.uploads.by_url import fetch_scan
from services.uploads.scans import (
    BLOCK_BYTES,
    accept_scan,
    discard_unused_scans,
    incoming_folder,
    safe_name,
    work_folder,
)

router = APIRouter(tags=["scans"])


@router.post("/scans", status_code=201)
async def post_scan(
    file: Annotated[UploadFile, File()], response: Response, owner: Owner, settings: Settings, store: Database
) -> dict:
    """Take in a scan of one file. 201 if it is new to you, 200 if you have brought its content before."""
    scan, new = await run_in_threadpool(_take_in, file, owner, settings, store)
    response.status_code = 201 if new else 200
    response.headers["Location"] = f"/v1/scans/{scan.id}"
    return scan_document(scan, settings)


class ScanAddress(BaseModel):
    """Where a scan is to be fetched from."""

    model_config = ConfigDict(extra="forbid")

    url: str = Field(max_length=2000, pattern=r"^(https?|s3)://[\x21-\x7e]+$")
    name: str = Field("", max_length=200, description="of the file; else the address's last part")


@router.post("/scans/by-url", status_code=201, responses={200: {"description": "you have brought its content before"}})
def post_scan_by_url(
    request: ScanAddress, response: Response, owner: Owner, settings: Settings, store: Database
) -> dict:
    """Fetch a scan from a public https address, or from a bucket that the operator allows; the answer comes when it is
    there and valid. Redirects are not followed."""
    before = store.scans(owner, 1, 0)[1]
    id = fetch_scan(request.url, request.name, owner, settings, store)
    response.status_code = 201 if store.scans(owner, 1, 0)[1] > before else 200
    response.headers["Location"] = f"/v1/scans/{id}"
    return scan_document(store.scan(id, owner), settings)


def _take_in(file: UploadFile, owner: str, settings, store) -> tuple[ScanRow, bool]:
    folder = incoming_folder(settings)
    try:
        path = folder / safe_name(file.filename or "")
        with open(path, "wb") as stream:
            shutil.copyfileobj(file.file, stream, BLOCK_BYTES)
        return accept_scan(path, owner, settings, store)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@router.get("/scans")
def get_scans(
    owner: Owner,
    settings: Settings,
    store: Database,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
    offset: Annotated[int, Query(ge=0, le=1 << 31)] = 0,
) -> dict:
    """The caller's scans, newest first, a page at a time."""
    rows, n_matched = store.scans(owner, limit, offset)
    documents = [scan_document(row, settings) for row in rows]
    return {"scans": documents, "numberMatched": n_matched, "numberReturned": len(rows)}


@router.get("/scans/{id}")
def get_scan(id: Hash, owner: Owner, settings: Settings, store: Database) -> dict:
    """Counts, cameras, bounds, warnings, and what the scan calls for: `effects`, once a job has measured it."""
    scan = store.scan(id, owner)
    if scan is None:
        raise Problem(404, "no-such-scan", f"no scan {id}")
    document = scan_document(scan, settings)
    measured = store.jobs(owner, 1, 0, scan=id)[1] > 0  # by a job of the owner's own
    return document | ({"effects": known_rows(work_folder(settings, id))} if measured else {})


@router.delete("/scans/{id}", status_code=204)
def delete_scan(id: Hash, owner: Owner, settings: Settings, store: Database) -> Response:
    """Forget a scan. Jobs that have ended keep their results; while one is under way the answer is 409."""
    if store.scan(id, owner) is None:
        raise Problem(404, "no-such-scan", f"no scan {id}")
    if not store.disown_scan(id, owner):
        raise Problem(409, "scan-in-use", f"a job on scan {id} is under way", hint="dismiss it first", retryable=True)
    discard_unused_scans(settings, store)
    return Response(status_code=204)
