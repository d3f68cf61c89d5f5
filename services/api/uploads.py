"""/v1/uploads: resumable uploads by tus 1.0.0, with the extensions creation, expiration, checksum and termination.

The bytes that are on disk are the truth of an upload's offset, so an API that is killed loses none that it wrote. Once
whole, an upload is validated and becomes a scan; one that is refused leaves nothing behind.
"""

from __future__ import annotations

import fcntl
import hashlib
import hmac
import json
import shutil
import time
from base64 import b64decode
from collections.abc import Iterator
from contextlib import contextmanager
from email.utils import formatdate
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Depends, Request, Response
from fastapi.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect

from pipeline.readers.detect import handled_suffixes
from services.api.context import Database, JobID, Owner, Settings
from services.jobs.documents import upload_document
from services.problems import Problem
from services.settings import ServiceSettings
from services.uploads.first_bytes import Look, look
from services.uploads.scans import accept_scan, safe_name

TUS = {"Tus-Resumable": "1.0.0"}
ALGORITHMS = ("sha256", "sha1", "md5")
OFFSET_TYPE = "application/offset+octet-stream"
MAX_METADATA = 4000
LOOKED = "looked.json"  # beside the bytes of an upload
REFUSALS = ("bad-scan", "archive-too-large")


def _check_version(request: Request) -> None:
    found = request.headers.get("tus-resumable")
    if request.method != "GET" and found != "1.0.0":
        raise Problem(
            412, "tus-version", f"Tus-Resumable is {found!r}; allowed: 1.0.0", headers={**TUS, "Tus-Version": "1.0.0"}
        )


router = APIRouter(prefix="/uploads", tags=["uploads"])
_versioned = [Depends(_check_version)]


@router.options("", status_code=204)
def get_abilities(settings: Settings) -> Response:
    return Response(
        status_code=204,
        headers={
            **TUS,
            "Tus-Version": "1.0.0",
            "Tus-Max-Size": str(settings.max_upload_bytes),
            "Tus-Extension": "creation,expiration,checksum,termination",
            "Tus-Checksum-Algorithm": ",".join(ALGORITHMS),
        },
    )


@router.post("", status_code=201, dependencies=_versioned)
def create(request: Request, owner: Owner, settings: Settings, store: Database) -> Response:
    """Begin an upload: Upload-Length, and Upload-Metadata with `filename`. Its address is the answer's Location."""
    length = _number(request, "upload-length")
    if length > settings.max_upload_bytes:
        raise Problem(
            413, "too-large", f"Upload-Length is {length:,}; allowed: {settings.max_upload_bytes:,} bytes", headers=TUS
        )
    if length > shutil.disk_usage(settings.data).free - settings.reserve_bytes:
        raise Problem(507, "disk-full", f"no room for {length:,} bytes", kind="resource", retryable=True, headers=TUS)
    text = request.headers.get("upload-metadata", "")
    file = safe_name(_metadata(text).get("filename", ""))
    if Path(file).suffix.lower() not in handled_suffixes():
        raise Problem(
            415, "unsupported-scan", f"filename is {file!r}; allowed: {', '.join(handled_suffixes())}", headers=TUS
        )
    upload = store.add_upload(
        {
            "owner": owner,
            "file": file,
            "length": length,
            "metadata": text,
            "expires": time.time() + settings.upload_expires_s,
        }
    )
    path = _path(settings, upload)
    path.parent.mkdir(parents=True)
    path.touch()
    return Response(status_code=201, headers={**TUS, **_state(upload, path), "Location": f"/v1/uploads/{upload['id']}"})


def upload_of(id: JobID, owner: Owner, settings: Settings, store: Database) -> dict:
    upload = store.upload(id, owner)
    if upload is None:
        raise Problem(404, "no-such-upload", f"no upload {id}", headers=TUS)
    if upload["expires"] < time.time():
        raise Problem(410, "expired", f"upload {id} has expired", headers=TUS)
    return upload


Upload = Annotated[dict, Depends(upload_of)]


@router.head("/{id}", dependencies=_versioned)
def head(upload: Upload, settings: Settings) -> Response:
    return Response(
        headers={
            **TUS,
            **_state(upload, _path(settings, upload)),
            "Cache-Control": "no-store",
            **({"Upload-Metadata": upload["metadata"]} if upload["metadata"] else {}),
        }
    )


@router.get("/{id}")
def get_upload(upload: Upload, settings: Settings) -> dict:
    """Where an upload stands, and the scan that it became."""
    return upload_document(upload, _offset(upload, _path(settings, upload)))


@router.delete("/{id}", status_code=204, dependencies=_versioned)
def delete(upload: Upload, settings: Settings, store: Database) -> Response:
    _discard(upload, settings, store)
    return Response(status_code=204, headers=TUS)


@router.patch("/{id}", status_code=204, dependencies=_versioned)
async def patch(upload: Upload, request: Request, owner: Owner, settings: Settings, store: Database) -> Response:
    """The bytes from Upload-Offset on. With the last of them the upload becomes a scan: Splatpress-Scan is its id."""
    if request.headers.get("content-type") != OFFSET_TYPE:
        raise Problem(
            415,
            "wrong-type",
            f"Content-Type is {request.headers.get('content-type')!r}; allowed: {OFFSET_TYPE}",
            headers=TUS,
        )
    offset, checksum = _number(request, "upload-offset"), _checksum(request)
    path = _path(settings, upload)
    with _only_writer(path):
        found = _offset(upload, path)
        if offset != found:
            raise Problem(
                409,
                "wrong-offset",
                f"Upload-Offset is {offset}; allowed: {found}",
                retryable=True,
                headers={**TUS, "Upload-Offset": str(found)},
            )
        if upload["scan"] is None:
            look = _Looking(upload, path, settings)
            try:
                await _append(path, request, upload["length"], offset, checksum, look)
            except Problem as problem:
                if problem.slug in REFUSALS:
                    _discard(upload, settings, store)
                problem.headers |= TUS
                raise
        if upload["scan"] is None and path.stat().st_size == upload["length"]:
            upload = await run_in_threadpool(_accept, upload, path, owner, settings, store)
        return Response(status_code=204, headers={**TUS, **_state(upload, path)})


class _Looking:
    """What has been seen of an upload by services/uploads/first_bytes.py, kept beside it from one piece to the next."""

    def __init__(self, upload: dict, path: Path, settings: ServiceSettings) -> None:
        self._upload, self._path, self._settings, self._kept = upload, path, settings, path.with_name(LOOKED)
        self._done = Look(**json.loads(self._kept.read_text())) if self._kept.exists() else Look()

    def __call__(self, n_there: int) -> None:
        before = self._done
        if before.at is not None and n_there > before.at:
            with open(self._path, "rb") as stream:
                self._done = look(stream, n_there, self._upload["length"], self._upload["file"], before, self._settings)

    def keep(self) -> None:
        self._kept.write_text(json.dumps(vars(self._done)))


async def _append(
    path: Path, request: Request, length: int, offset: int, checksum: tuple[str, bytes] | None, look: _Looking
) -> None:
    """A piece with a checksum counts whole or not at all; without one, every byte that arrived. Looked at as it
    arrives, or once its checksum has been: damage on the way is no fault of the scan."""
    digest = hashlib.new(checksum[0]) if checksum else None
    whole = False
    with open(path, "r+b", buffering=0) as stream:
        stream.seek(offset)
        try:
            async for block in request.stream():
                if stream.tell() + len(block) > length:
                    raise Problem(413, "too-large", f"more bytes than Upload-Length, {length:,}", headers=TUS)
                if digest:
                    digest.update(block)
                stream.write(block)
                if not digest:
                    look(stream.tell())
            whole = True
        except ClientDisconnect:
            pass
        finally:
            if digest and not (whole and hmac.compare_digest(digest.digest(), checksum[1])):
                stream.truncate(offset)
                stream.seek(offset)
        if whole and digest and digest.digest() != checksum[1]:
            raise Problem(
                460, "checksum-mismatch", "the bytes do not have the Upload-Checksum", retryable=True, headers=TUS
            )
        look(stream.tell())
        look.keep()


def _accept(upload: dict, path: Path, owner: str, settings: ServiceSettings, store) -> dict:
    try:
        scan, _ = accept_scan(path, owner, settings, store)
    except Problem as problem:
        _discard(upload, settings, store)
        problem.headers |= TUS
        raise
    store.end_upload(upload["id"], scan["id"], None)
    shutil.rmtree(path.parent, ignore_errors=True)
    return {**upload, "scan": scan["id"]}


def _discard(upload: dict, settings: ServiceSettings, store) -> None:
    store.forget_upload(upload["id"])
    shutil.rmtree(_path(settings, upload).parent, ignore_errors=True)


def _path(settings: ServiceSettings, upload: dict) -> Path:
    return settings.data / "uploads" / upload["id"] / upload["file"]


def _offset(upload: dict, path: Path) -> int:
    return upload["length"] if upload["scan"] else path.stat().st_size if path.exists() else 0


def _state(upload: dict, path: Path) -> dict[str, str]:
    return {
        "Upload-Offset": str(_offset(upload, path)),
        "Upload-Length": str(upload["length"]),
        "Upload-Expires": formatdate(upload["expires"], usegmt=True),
        **({"Splatpress-Scan": upload["scan"]} if upload["scan"] else {}),
    }


@contextmanager
def _only_writer(path: Path) -> Iterator[None]:
    """Two requests that write one upload would mix their bytes. The kernel frees the lock of a process that died."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "ab") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise Problem(
                423, "locked", "another request is writing this upload", retryable=True, headers=TUS
            ) from None
        yield


def _number(request: Request, name: str) -> int:
    text = request.headers.get(name, "")
    if not (text.isascii() and text.isdigit() and len(text) <= 18):
        raise Problem(400, "wrong-header", f"{name.title()} is {text!r}; allowed: a whole number", headers=TUS)
    return int(text)


def _metadata(text: str) -> dict[str, str]:
    """Pairs of a key and a base64 value, with commas between them."""
    if len(text) > MAX_METADATA:
        raise Problem(
            400, "wrong-header", f"Upload-Metadata of {len(text)} characters; allowed: {MAX_METADATA}", headers=TUS
        )
    pairs = (part.strip().partition(" ") for part in text.split(",") if part.strip())
    try:
        return {key: b64decode(value, validate=True).decode() for key, _, value in pairs}
    except ValueError:
        raise Problem(
            400, "wrong-header", "Upload-Metadata has a value that is not base64 of UTF-8", headers=TUS
        ) from None


def _checksum(request: Request) -> tuple[str, bytes] | None:
    text = request.headers.get("upload-checksum")
    if text is None:
        return None
    algorithm, _, value = text.partition(" ")
    try:
        digest = b64decode(value, validate=True)
    except ValueError:
        digest = b""
    if algorithm not in ALGORITHMS or not digest:
        raise Problem(
            400,
            "wrong-header",
            f"Upload-Checksum is {text[:80]!r}; allowed: {', '.join(ALGORITHMS)} and base64",
            headers=TUS,
        )
    return algorithm, digest
