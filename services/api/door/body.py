"""What may be told of a request's body while it arrives, whatever its headers say and however it is parsed then."""

from __future__ import annotations

import asyncio
import io
import json
import re
import shutil
from collections.abc import Callable

from sqlalchemy.exc import InterfaceError, OperationalError
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request

from services.problems import RESOURCE, Problem
from services.settings import ServiceSettings
from services.uploads.early_checks import PEEK_BYTES, Look, look
from services.uploads.scans import safe_name

MAX_JSON_BYTES = 1 << 20
MULTIPART_OVERHEAD = 1 << 16
FIRST_BYTES = PEEK_BYTES + MULTIPART_OVERHEAD  # of a multipart body: what its first file begins with
ROOM_EVERY_BYTES = 64 << 20
CHANGING = ("POST", "PUT", "PATCH", "DELETE")  # methods that may have a body; all of them under /v1 need an owner
Guard = Callable[[bytes], None]  # hears each block of a body; raises Problem to refuse it


class BodyGuard:
    """ASGI middleware. `admit(request)` says who may send a body at all, and raises Problem before a byte of it is
    read; `guards(method, path, promised bytes or 0)` gives the guards that it passes. A body that stands still for
    `idle_s` is ended: to the application it looks cut off, the client hears 408."""

    def __init__(
        self,
        app,
        admit: Callable[[Request], None],
        guards: Callable[[str, str, int], list[Guard]],
        idle_s: float,
    ) -> None:
        self.app, self.admit, self.guards, self.idle_s = app, admit, guards, idle_s

    async def __call__(self, scope, receive, send) -> None:
        if scope["type"] != "http":
            return await self.app(scope, receive, send)
        scope = _overridden(scope)
        promised = dict(scope["headers"]).get(b"content-length", b"0")
        try:
            if scope["method"] in CHANGING and scope["path"].startswith("/v1/"):
                await run_in_threadpool(self.admit, Request(scope))
            guards = self.guards(scope["method"], scope["path"], int(promised) if promised.isdigit() else 0)
        except Problem as problem:
            return await _refuse(send, problem)
        except (OperationalError, InterfaceError):
            guards = []  # the database is away: the endpoint will say so
        refusal: Problem | None = None
        answered = whole = False

        async def guarded():
            nonlocal refusal, whole
            try:
                async with asyncio.timeout(None if whole else self.idle_s):
                    message = await receive()
                whole = whole or not message.get("more_body", False)
                for guard in guards if refusal is None else ():
                    guard(message.get("body", b""))
            except TimeoutError:
                refusal = Problem(408, "stalled", f"no byte of the body for {self.idle_s:g} s", retryable=True)
            except Problem as problem:
                refusal = problem
            return message if refusal is None else {"type": "http.disconnect"}

        async def noted(message):
            nonlocal answered
            if refusal is None or answered:
                answered = True
                await send(message)

        try:
            await self.app(scope, guarded, noted)
        except Exception:
            if refusal is None:
                raise
        if refusal is not None and not answered:
            await _refuse(send, refusal)


def _overridden(scope: dict) -> dict:
    """tus: a POST may say that it stands for another method, where something on the way lets no other through."""
    asked = dict(scope["headers"]).get(b"x-http-method-override", b"").decode("latin-1").upper()
    may = (
        scope["method"] == "POST" and scope["path"].startswith("/v1/uploads/") and asked in ("PATCH", "DELETE", "HEAD")
    )
    return {**scope, "method": asked} if may else scope


def cap(allowed: int, promised: int) -> Guard:
    """No more than so many bytes. Raises Problem at once where more are promised."""
    too_many = Problem(
        413,
        "too-large",
        f"a body of more than {allowed:,} bytes",
        hint="larger scans go through /v1/uploads, which takes them in pieces",
    )
    if promised > allowed:
        raise too_many
    n_read = 0

    def guard(block: bytes) -> None:
        nonlocal n_read
        n_read += len(block)
        if n_read > allowed:
            raise too_many

    return guard


def room(settings: ServiceSettings, promised: int) -> Guard:
    """A multipart body lies on disk twice for a moment. Raises Problem at once where it would not fit."""
    full = Problem(507, "disk-full", f"no room for {promised:,} bytes", kind=RESOURCE, retryable=True)

    def left() -> int:
        return shutil.disk_usage(settings.data).free - settings.reserve_bytes

    if 2 * promised > left():
        raise full
    n_read = n_looked = 0

    def guard(block: bytes) -> None:
        nonlocal n_read, n_looked
        n_read += len(block)
        if n_read - n_looked > ROOM_EVERY_BYTES:
            n_looked = n_read
            if left() < n_read:
                raise full

    return guard


def first_look(settings: ServiceSettings, promised: int) -> Guard:
    """The beginning of the first file of a multipart body must be that of a scan. A file is shorter than the body."""
    head: bytearray | None = bytearray()

    def guard(block: bytes) -> None:
        nonlocal head
        if head is None:
            return
        head += block
        named = re.search(rb'filename="([^"]*)"[\s\S]*?\r\n\r\n', head[:MULTIPART_OVERHEAD])
        if named:
            name, content = safe_name(named[1].decode(errors="replace")), bytes(head[named.end() :])
            boundary = head[: head.find(b"\r\n")]
            if boundary not in content:  # else it is there whole, and is looked at as such
                look(
                    io.BytesIO(content), len(content), promised or settings.max_multipart_bytes, name, Look(), settings
                )
        if len(head) > FIRST_BYTES:
            head = None

    return guard


async def _refuse(send, problem: Problem) -> None:
    body = json.dumps(problem.body()).encode()
    extra = [(name.lower().encode(), value.encode()) for name, value in problem.headers.items()]
    await send(
        {
            "type": "http.response.start",
            "status": problem.status,
            "headers": [
                (b"content-type", b"application/problem+json"),
                (b"content-length", str(len(body)).encode()),
                (b"connection", b"close"),
                *extra,
            ],
        }
    )
    await send({"type": "http.response.body", "body": body})
