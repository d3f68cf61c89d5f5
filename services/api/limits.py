"""What may be told of a request's body while it arrives, whatever its headers say and however it is parsed then."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable

from services.problems import Problem
from services.settings import ServiceSettings
from services.uploads.first_bytes import PEEK_BYTES, Look, look
from services.uploads.scans import safe_name

MAX_JSON_BYTES = 1 << 20
MULTIPART_OVERHEAD = 1 << 16
FIRST_BYTES = PEEK_BYTES + MULTIPART_OVERHEAD  # of a multipart body: what its first file begins with
Guard = Callable[[bytes], None]  # hears each block of a body; raises Problem to refuse it


class BodyGuard:
    """ASGI middleware; `guards(method, path, promised bytes or 0)` gives those that a request's body passes."""

    def __init__(self, app, guards: Callable[[str, str, int], list[Guard]]) -> None:
        self.app, self.guards = app, guards

    async def __call__(self, scope, receive, send) -> None:
        if scope["type"] != "http":
            return await self.app(scope, receive, send)
        promised = dict(scope["headers"]).get(b"content-length", b"0")
        try:
            guards = self.guards(scope["method"], scope["path"], int(promised) if promised.isdigit() else 0)
        except Problem as problem:
            return await _refuse(send, problem)
        refusal: Problem | None = None
        answered = False

        async def guarded():
            nonlocal refusal
            message = await receive()
            try:
                for guard in guards if refusal is None else ():
                    guard(message.get("body", b""))
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
    await send(
        {
            "type": "http.response.start",
            "status": problem.status,
            "headers": [
                (b"content-type", b"application/problem+json"),
                (b"content-length", str(len(body)).encode()),
                (b"connection", b"close"),
            ],
        }
    )
    await send({"type": "http.response.body", "body": body})
