"""Writing an upload: one request at a time, and the newest one of its owner.

The bytes on disk are the truth of an upload's offset. A request that writes holds a lock of the kernel's, which dies
with its process; one that comes later asks for it by a file beside the upload, also from another process, and the
holder gives way at its next block or poll. A connection that hangs therefore never keeps its owner from going on.
"""

from __future__ import annotations

import asyncio
import errno
import hashlib
import hmac
import os
import shutil
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path

from starlette.requests import ClientDisconnect, Request

from services.uploads.tus import refusal
from storage.file_lock import try_to_hold

LOCK, WANTED = "lock", "wanted"
POLL_S, PATIENCE_S = 0.1, 5.0  # a holder looks every POLL_S; what it does with its last byte may take longer
LOOK_FOR_ROOM_BYTES = 64 << 20


@asynccontextmanager
async def only_writer(folder: Path) -> AsyncIterator[None]:
    """Alone in the folder of an upload; where there is none any more, there is nothing to write either.

    Raises: Problem 423 where the holder does not give way, because it is taking the scan in.
    """
    if not folder.is_dir():
        yield
        return
    deadline = time.monotonic() + PATIENCE_S
    with open(folder / LOCK, "w") as lock:
        while not try_to_hold(lock):
            if time.monotonic() > deadline:
                raise refusal(423, "locked", "another request is writing this upload", retryable=True)
            with suppress(FileNotFoundError):  # the holder may have discarded it
                (folder / WANTED).touch()
            await asyncio.sleep(POLL_S)
        (folder / WANTED).unlink(missing_ok=True)
        yield


async def append(
    path: Path,
    request: Request,
    offset: int,
    length: int,
    checksum: tuple[str, bytes] | None,
    look: Callable[[int], None],
    reserve_bytes: int,
) -> None:
    """The request's body to the file from `offset` on. A body with a checksum counts whole or not at all; without one,
    every byte that arrived, whatever then became of the request. `look` hears how many bytes are there.

    Raises: Problem for more bytes than `length`, a wrong checksum, a disk that is full, a newer request that wants to
    write, and what `look` raises.
    """
    digest = hashlib.new(checksum[0]) if checksum else None
    whole = False
    with open(path, "r+b", buffering=0) as stream:
        stream.seek(offset)
        try:
            async for block in _blocks(request, path.parent):
                if stream.tell() + len(block) > length:
                    raise refusal(413, "too-large", f"more bytes than Upload-Length, {length:,}")
                if digest:
                    digest.update(block)
                _write(stream, block, reserve_bytes)
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
            raise refusal(460, "checksum-mismatch", "the bytes do not have the Upload-Checksum", retryable=True)
        look(stream.tell())


def _write(stream, block: bytes, reserve_bytes: int) -> None:
    try:
        before = stream.tell() // LOOK_FOR_ROOM_BYTES
        rest = memoryview(block)
        while rest:
            rest = rest[stream.write(rest) :]
        full = stream.tell() // LOOK_FOR_ROOM_BYTES > before and shutil.disk_usage(stream.name).free < reserve_bytes
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        full = True
    if full:
        raise refusal(507, "disk-full", "no room for more of this upload", kind="resource", retryable=True)


async def _blocks(request: Request, folder: Path) -> AsyncIterator[bytes]:
    """The body as it arrives. Raises Problem 423 once another request wants to write."""
    stream = request.stream()
    waiting: asyncio.Task | None = None
    try:
        while True:
            if (folder / WANTED).exists():
                raise refusal(423, "taken-over", "a newer request goes on with this upload", retryable=True)
            waiting = waiting or asyncio.create_task(_next(stream))
            done, _ = await asyncio.wait({waiting}, timeout=POLL_S)
            if done:
                block, waiting = waiting.result(), None
                if block is None:
                    return
                yield block
    finally:
        if waiting is not None:
            waiting.cancel()
            with suppress(asyncio.CancelledError, ClientDisconnect):
                await waiting
        await stream.aclose()


async def _next(stream: AsyncIterator[bytes]) -> bytes | None:
    return await anext(stream, None)


def join(parts: list[Path], path: Path) -> None:
    """The parts' bytes one after the other, on disk once this returns."""
    with open(path, "wb") as target:
        for part in parts:
            with open(part, "rb") as source:
                shutil.copyfileobj(source, target, 1 << 20)
        target.flush()
        os.fsync(target.fileno())
