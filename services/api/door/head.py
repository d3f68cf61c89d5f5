"""HEAD of whatever GET answers, without its body (RFC 9110, 9.3.2)."""

from __future__ import annotations

OWN = ("/v1/uploads/", "/artifacts/")  # have a HEAD of their own
ENDLESS = ("/events", "/archive")  # no end, or an effort that nobody would see


class Head:
    """ASGI middleware."""

    def __init__(self, app) -> None:
        self.app = app

    async def __call__(self, scope, receive, send) -> None:
        path = scope.get("path", "")
        own = any(part in path for part in OWN) or path.endswith(ENDLESS)
        if scope["type"] != "http" or scope["method"] != "HEAD" or own:
            return await self.app(scope, receive, send)

        async def without_body(message) -> None:
            await send({**message, "body": b""} if message["type"] == "http.response.body" else message)

        await self.app({**scope, "method": "GET"}, receive, without_body)
