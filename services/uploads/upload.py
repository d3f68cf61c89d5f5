"""What becomes of an upload: begun where there is room, written, looked at as it arrives, and once whole a scan; one
that is refused leaves nothing behind."""

from __future__ import annotations

import json
import shutil
import time
from dataclasses import asdict, replace
from email.utils import formatdate
from pathlib import Path

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request

from services.problems import Problem
from services.settings import ServiceSettings
from services.store.rows import UploadRow
from services.store.store import Store
from services.uploads.early_checks import Look, look
from services.uploads.room import check_room, received, upload_path
from services.uploads.scans import accept_scan
from services.uploads.tus import JOINED, LATER, PART, TUS, refusal
from services.uploads.writer import append, join

LOOKED = "looked.json"  # beside the bytes of an upload
REFUSALS = ("bad-scan", "archive-too-large")


def begin(
    owner: str, file: str, length: int, metadata: str, concat: str, settings: ServiceSettings, store: Store
) -> UploadRow:
    """Raises Problem where there is no room for it; then nothing was begun."""
    expires = time.time() + settings.upload_expires_s
    upload = store.add_upload(owner, file, length, metadata, expires, concat)
    try:
        check_room(upload, settings, store)
    except Problem:
        store.forget_upload(upload.id)
        raise
    path = upload_path(settings, upload)
    path.parent.mkdir(parents=True)
    path.touch()
    return upload


def said_length(upload: UploadRow, length: int, settings: ServiceSettings, store: Store) -> UploadRow:
    """The upload with the length that was to be said later."""
    if upload.length not in (LATER, length):
        raise refusal(400, "wrong-header", f"Upload-Length is {length:,}; allowed: {upload.length:,}, as it was before")
    if upload.length == LATER:
        store.change_upload(upload.id, length=length)
        try:
            check_room(replace(upload, length=length), settings, store)
        except Problem:
            store.change_upload(upload.id, length=LATER)
            raise
    return replace(upload, length=length)


async def write(
    upload: UploadRow,
    request: Request,
    offset: int,
    checksum: tuple[str, bytes] | None,
    settings: ServiceSettings,
    store: Store,
) -> UploadRow:
    """The request's body, by the one that holds the upload's lock. With the last byte the upload becomes a scan."""
    path = upload_path(settings, upload)
    if upload.scan is None:
        expires = time.time() + settings.upload_expires_s
        await run_in_threadpool(store.change_upload, upload.id, expires=expires)
        upload = replace(upload, expires=expires)
        length = settings.max_upload_bytes if upload.length == LATER else upload.length
        looking = Looking(path, length, upload, settings)
        try:
            await append(path, request, offset, length, checksum, looking, settings.reserve_bytes)
        except Problem as problem:
            if problem.slug in REFUSALS:
                discard(upload, settings, store)
            problem.headers |= TUS
            raise
        finally:
            looking.keep()
        if path.stat().st_size == upload.length and upload.concat != PART:
            upload = await run_in_threadpool(accept, upload, settings, store)
    return upload


def joined(upload: UploadRow, parts: list[UploadRow], settings: ServiceSettings, store: Store) -> UploadRow:
    """An upload made of others, which go with it."""
    join([upload_path(settings, part) for part in parts], upload_path(settings, upload))
    upload = accept(upload, settings, store)
    for part in parts:
        discard(part, settings, store)
    return upload


def accept(upload: UploadRow, settings: ServiceSettings, store: Store) -> UploadRow:
    """Make a scan of an upload that is whole. Raises: Problem; what is no scan is discarded."""
    path = upload_path(settings, upload)
    try:
        scan, _ = accept_scan(path, upload.owner, settings, store)
    except Problem as problem:
        if problem.kind == "data":
            discard(upload, settings, store)
        problem.headers |= TUS
        raise
    store.change_upload(upload.id, scan=scan.id)
    shutil.rmtree(path.parent, ignore_errors=True)
    return replace(upload, scan=scan.id)


def discard(upload: UploadRow, settings: ServiceSettings, store: Store) -> None:
    """Forget an upload and what has arrived of it."""
    store.forget_upload(upload.id)
    shutil.rmtree(upload_path(settings, upload).parent, ignore_errors=True)


def offset_of(upload: UploadRow, settings: ServiceSettings) -> int:
    """How many bytes of an upload have arrived."""
    return upload.length if upload.scan else received(settings, upload)


def state(upload: UploadRow, settings: ServiceSettings) -> dict[str, str]:
    """The headers that say where an upload stands."""
    length = {"Upload-Defer-Length": "1"} if upload.length == LATER else {"Upload-Length": str(upload.length)}
    return {
        **TUS,
        "Upload-Offset": str(offset_of(upload, settings)),
        **length,
        "Upload-Expires": formatdate(upload.expires, usegmt=True),
        **({"Upload-Concat": upload.concat} if upload.concat else {}),
        **({"Splatpress-Scan": upload.scan} if upload.scan else {}),
    }


class Looking:
    """What has been seen of an upload by services/uploads/early_checks.py, kept beside it from one piece to the next. A
    part of another begins in its middle, and is not looked at."""

    def __init__(self, path: Path, length: int, upload: UploadRow, settings: ServiceSettings) -> None:
        self._path, self._length, self._settings, self._kept = path, length, settings, path.with_name(LOOKED)
        self._file = None if upload.concat in (PART,) or upload.concat.startswith(JOINED) else upload.file
        self._done = Look(**json.loads(self._kept.read_text())) if self._kept.exists() else Look()

    def __call__(self, n_there: int) -> None:
        before = self._done
        if self._file is not None and before.at is not None and n_there > before.at:
            with open(self._path, "rb") as stream:
                self._done = look(stream, n_there, self._length, self._file, before, self._settings)

    def keep(self) -> None:
        if self._path.parent.is_dir():
            self._kept.write_text(json.dumps(asdict(self._done)))
