"""What every answer says to browsers, and a note of who changed what."""

from __future__ import annotations

from sqlalchemy.exc import InterfaceError, OperationalError
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import MutableHeaders
from starlette.requests import Request

from services.api.door.body import CHANGING
from services.store.tokens import note_action

_SECURITY = {
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "x-frame-options": "DENY",
    "content-security-policy": "default-src 'self'; img-src 'self' blob: data:; frame-ancestors 'none'",
}


class Secured:
    """ASGI middleware: bodies pass as they are, where Starlette's own for functions takes each block through a
    queue."""

    def __init__(self, app) -> None:
        self.app = app

    async def __call__(self, scope, receive, send) -> None:
        if scope["type"] != "http":
            return await self.app(scope, receive, send)
        scope.setdefault("state", {})  # what is within notes the owner there
        request = Request(scope)

        async def secured(message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(raw=list(message.get("headers", [])))
                for name, value in _SECURITY.items():
                    headers.setdefault(name, value)
                if scope["method"] in CHANGING and message["status"] < 400 and hasattr(request.state, "owner"):
                    await run_in_threadpool(_note, request)
                message = {**message, "headers": headers.raw}
            await send(message)

        await self.app(scope, receive, secured)


def _note(request: Request) -> None:
    """Who did what. A piece of an upload is no deed of its own."""
    path = request.url.path
    if request.method == "PATCH" and path.startswith("/v1/uploads/"):
        return
    client = request.client.host if request.client else ""
    kind, _, target = path.removeprefix("/v1/").partition("/")
    try:
        note_action(request.app.state.store, request.state.owner, f"{request.method} {kind}", target, client)
    except (OperationalError, InterfaceError):
        pass  # what was done is done, and the database away since
