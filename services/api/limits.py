"""A cap on the bytes of a request's body, whatever its headers say and however it is parsed."""

from __future__ import annotations

import json
from collections.abc import Callable

from services.problems import Problem

MAX_JSON_BYTES = 1 << 20
MULTIPART_OVERHEAD = 1 << 16


class BodyCap:
    """ASGI middleware; `limit(method, path)` gives the bytes allowed, None for a route that counts by itself."""

    def __init__(self, app, limit: Callable[[str, str], int | None]) -> None:
        self.app, self.limit = app, limit

    async def __call__(self, scope, receive, send) -> None:
        allowed = self.limit(scope["method"], scope["path"]) if scope["type"] == "http" else None
        if allowed is None:
            return await self.app(scope, receive, send)
        promised = dict(scope["headers"]).get(b"content-length", b"0")
        if promised.isdigit() and int(promised) > allowed:
            return await _refuse(send, allowed)
        n_read, answered = 0, False

        async def counted():
            nonlocal n_read
            message = await receive()
            n_read += len(message.get("body", b""))
            if n_read > allowed:
                raise _TooLarge
            return message

        async def noted(message):
            nonlocal answered
            answered = True
            await send(message)

        try:
            await self.app(scope, counted, noted)
        except _TooLarge:
            if not answered:
                await _refuse(send, allowed)


class _TooLarge(Exception):
    pass


async def _refuse(send, allowed: int) -> None:
    body = json.dumps(Problem(413, "too-large", f"a body of more than {allowed:,} bytes", hint="larger scans go through "
                              "/v1/uploads, which takes them in pieces").body()).encode()
    await send({"type": "http.response.start", "status": 413, "headers": [
        (b"content-type", b"application/problem+json"), (b"content-length", str(len(body)).encode()), (b"connection", b"close")]})
    await send({"type": "http.response.body", "body": body})
