"""/v1/uploads: resumable uploads by tus 1.0.0, with the extensions that services/uploads/tus.py lists.

The bytes that are on disk are the truth of an upload's offset, so an API that is killed loses none that it wrote. Once
whole, an upload is validated and becomes a scan; one that is refused leaves nothing behind.
"""

from __future__ import annotations

import time
from typing import Annotated

from fastapi import APIRouter, Depends, Request, Response
from fastapi.concurrency import run_in_threadpool

from services.api.context import Database, JobID, Owner, Settings
from services.jobs.documents import upload_document
from services.problems import Problem
from services.settings import ServiceSettings
from services.store.rows import UploadRow
from services.store.store import Store
from services.uploads import tus
from services.uploads.room import upload_path
from services.uploads.scans import safe_name
from services.uploads.upload import begin, discard, joined, offset_of, said_length, state, write
from services.uploads.volumes import check_name
from services.uploads.writer import only_writer

router = APIRouter(prefix="/uploads", tags=["uploads"])
_versioned = [Depends(tus.check_version)]
_ABILITIES = {
    **tus.TUS,
    "Tus-Version": tus.VERSION,
    "Tus-Extension": ",".join(tus.EXTENSIONS),
    "Tus-Checksum-Algorithm": ",".join(tus.ALGORITHMS),
}


@router.options("", status_code=204)
def get_abilities(settings: Settings) -> Response:
    """What of tus the service does."""
    return Response(status_code=204, headers={**_ABILITIES, "Tus-Max-Size": str(settings.max_upload_bytes)})


@router.options("/{id}", status_code=204)
def get_abilities_of_one(id: JobID, settings: Settings) -> Response:
    """What of tus the service does, asked of one upload."""
    return get_abilities(settings)


@router.get("")
def get_uploads(owner: Owner, settings: Settings, store: Database) -> dict:
    """Those of yours that are not whole yet."""
    mine = [upload for upload in store.open_uploads() if upload.owner == owner]
    return {"uploads": [upload_document(upload, offset_of(upload, settings)) for upload in mine]}


@router.post("", status_code=201, dependencies=_versioned)
async def create(request: Request, owner: Owner, settings: Settings, store: Database) -> Response:
    """Begin an upload: Upload-Length or Upload-Defer-Length, and Upload-Metadata with `filename`. Its address is the
    answer's Location. A body is its first bytes; Upload-Concat makes a part of another, or one of its parts."""
    concat = tus.concat(request)
    if concat.startswith(tus.JOINED):
        upload = await run_in_threadpool(_join, concat, request, owner, settings, store)
    else:
        upload = await run_in_threadpool(_begin, request, concat, owner, settings, store)
        if request.headers.get("content-type") == tus.OFFSET_TYPE:
            async with only_writer(upload_path(settings, upload).parent):
                upload = await write(upload, request, 0, tus.checksum(request), settings, store)
    headers = {**state(upload, settings), "Location": f"/v1/uploads/{upload.id}"}
    return Response(status_code=201, headers=headers)


def _begin(request: Request, concat: str, owner: str, settings: ServiceSettings, store: Store) -> UploadRow:
    length, text = tus.length_of(request), request.headers.get("upload-metadata", "")
    _check_length(length, settings)
    file = safe_name(tus.metadata(text).get("filename", ""))
    if concat != tus.PART:
        _check_file(file)
    return begin(owner, file, length, text, concat, settings, store)


def _join(concat: str, request: Request, owner: str, settings: ServiceSettings, store: Store) -> UploadRow:
    """Raises Problem where a part is not the owner's, is no part, or is not whole yet."""
    text = request.headers.get("upload-metadata", "")
    file = safe_name(tus.metadata(text).get("filename", ""))
    _check_file(file)
    parts = [store.upload(id, owner) for id in tus.parts_of(concat)]
    for part, id in zip(parts, tus.parts_of(concat), strict=True):
        if part is None or part.concat != tus.PART:
            raise tus.refusal(400, "no-such-part", f"{id[:80]} is no partial upload")
        if offset_of(part, settings) != part.length:
            raise tus.refusal(400, "part-not-whole", f"{id} has {offset_of(part, settings):,} of {part.length:,} bytes")
    if len({part.id for part in parts}) != len(parts):
        raise tus.refusal(400, "part-twice", "Upload-Concat names a part twice")
    length = sum(part.length for part in parts)
    _check_length(length, settings)
    return joined(begin(owner, file, length, text, concat, settings, store), parts, settings, store)


def _check_length(length: int, settings: ServiceSettings) -> None:
    if length > settings.max_upload_bytes:
        detail = f"Upload-Length is {length:,}; allowed: {settings.max_upload_bytes:,} bytes"
        raise tus.refusal(413, "too-large", detail)


def _check_file(file: str) -> None:
    try:
        check_name(file, "filename is ")
    except Problem as problem:
        raise tus.refusal(problem.status, problem.slug, problem.detail) from None


def upload_of(id: JobID, owner: Owner, settings: Settings, store: Database) -> UploadRow:
    """The caller's upload of that id. Raises: Problem 404 where there is none."""
    upload = store.upload(id, owner)
    if upload is None:
        raise tus.refusal(404, "no-such-upload", f"no upload {id}")
    if upload.expires < time.time():
        raise tus.refusal(410, "expired", f"upload {id} has expired")
    return upload


Upload = Annotated[UploadRow, Depends(upload_of)]


@router.head("/{id}", dependencies=_versioned)
def head(upload: Upload, settings: Settings) -> Response:
    """How far an upload is."""
    metadata = {"Upload-Metadata": upload.metadata} if upload.metadata else {}
    return Response(headers={**state(upload, settings), "Cache-Control": "no-store", **metadata})


@router.get("/{id}")
def get_upload(upload: Upload, settings: Settings) -> dict:
    """Where an upload stands, and the scan that it became."""
    return upload_document(upload, offset_of(upload, settings))


@router.delete("/{id}", status_code=204, dependencies=_versioned)
async def delete(upload: Upload, settings: Settings, store: Database) -> Response:
    """End an upload and forget what has arrived."""
    async with only_writer(upload_path(settings, upload).parent):
        await run_in_threadpool(discard, upload, settings, store)
    return Response(status_code=204, headers=tus.TUS)


@router.patch("/{id}", status_code=204, dependencies=_versioned)
async def patch(upload: Upload, request: Request, settings: Settings, store: Database) -> Response:
    """The bytes from Upload-Offset on. With the last of them the upload becomes a scan: Splatpress-Scan is its id."""
    found = request.headers.get("content-type")
    if found != tus.OFFSET_TYPE:
        raise tus.refusal(415, "wrong-type", f"Content-Type is {found!r}; allowed: {tus.OFFSET_TYPE}")
    offset, checksum = tus.number(request, "upload-offset"), tus.checksum(request)
    async with only_writer(upload_path(settings, upload).parent):
        upload = await run_in_threadpool(store.upload, upload.id)  # the holder before may have ended it
        if upload is None:
            raise tus.refusal(404, "no-such-upload", "the upload is gone")
        there = offset_of(upload, settings)
        if offset != there:
            headers = {"Upload-Offset": str(there)}
            detail = f"Upload-Offset is {offset}; allowed: {there}"
            raise tus.refusal(409, "wrong-offset", detail, retryable=True, headers=headers)
        if "upload-length" in request.headers:
            length = tus.number(request, "upload-length")
            _check_length(length, settings)
            upload = await run_in_threadpool(said_length, upload, length, settings, store)
        upload = await write(upload, request, offset, checksum, settings, store)
        return Response(status_code=204, headers=state(upload, settings))
