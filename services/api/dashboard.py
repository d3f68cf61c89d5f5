"""/dashboard: Dask's own pages, passed on to whoever has a token; the scheduler itself stays where only we reach it.

A browser sends no Authorization header with a link, so the page trades its token for a cookie that goes to these
addresses alone and that no script reads. The pages show every owner's tasks by the ids of their jobs; what they could
change, or reach beyond the scheduler, is not passed on.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import Annotated
from urllib.parse import urlsplit

import httpx
from fastapi import APIRouter, Depends, Request, Response, WebSocket
from fastapi.responses import RedirectResponse, StreamingResponse
from starlette.requests import HTTPConnection
from starlette.websockets import WebSocketDisconnect

from services.api.context import Owner, Settings, owner_of_connection
from services.jobs.heartbeat import dashboard
from services.problems import RESOURCE, Problem
from services.settings import ServiceSettings

router = APIRouter(include_in_schema=False)
PATH, COOKIE = "/dashboard", "splatpress-dashboard"
_KEPT_BACK = ("proxy", "api")  # other hosts' pages; what changes a cluster
_PASSED = ("accept", "accept-language", "if-none-match", "if-modified-since", "range", "user-agent")
_RETURNED = ("content-type", "etag", "last-modified", "cache-control", "content-range", "accept-ranges")
# Bokeh makes functions of texts, and talks to the address that it came from.
_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data:; font-src 'self' data:; frame-src 'self'; frame-ancestors 'self'"
)


@router.post("/v1/dashboard", status_code=204)
def post_dashboard(request: Request, owner: Owner) -> Response:
    """The token of this request as a cookie for the pages below /dashboard, until the browser is closed."""
    response = Response(status_code=204)
    _, _, token = request.headers.get("authorization", "").partition(" ")
    if token:
        told = {"path": PATH, "httponly": True, "samesite": "strict", "secure": request.url.scheme == "https"}
        response.set_cookie(COOKIE, token.strip(), **told)  # type: ignore[arg-type]
    return response


@router.delete("/v1/dashboard", status_code=204)
def delete_dashboard() -> Response:
    """Signed out: the cookie goes."""
    response = Response(status_code=204)
    response.delete_cookie(COOKIE, path=PATH)
    return response


def _visitor(connection: HTTPConnection) -> str:
    return owner_of_connection(connection, connection.cookies.get(COOKIE, ""))


Visitor = Annotated[str, Depends(_visitor)]


def _base(settings: ServiceSettings) -> str:
    """Scheme, host and port. Raises Problem where there is no scheduler, or one that tells no address."""
    told = urlsplit(settings.dashboard_url or dashboard(settings.place))
    if told.scheme not in ("http", "https") or not told.netloc:
        raise Problem(503, "no-dashboard", "no dashboard of Dask's is known", kind=RESOURCE, retryable=True)
    return f"{told.scheme}://{told.netloc}"


def _checked(path: str) -> str:
    parts = path.split("/")
    if parts[0] in _KEPT_BACK or ".." in parts:
        raise Problem(404, "not-found", f"no page {path!r}")
    return path


@router.get(PATH)
@router.get(PATH + "/")
def get_first(visitor: Visitor) -> RedirectResponse:
    """The first page of Dask's dashboard."""
    return RedirectResponse(PATH + "/status")


@router.get(PATH + "/{path:path}")
async def get_page(path: str, request: Request, visitor: Visitor, settings: Settings) -> StreamingResponse:
    """A page of Dask's dashboard."""
    client = httpx.AsyncClient(timeout=30, trust_env=False)
    url = httpx.URL(f"{_base(settings)}/{_checked(path)}", query=request.url.query.encode())
    passed = {name: request.headers[name] for name in _PASSED if name in request.headers}
    try:
        answer = await client.send(client.build_request("GET", url, headers=passed), stream=True)
    except httpx.TransportError as error:
        await client.aclose()
        raise Problem(503, "no-dashboard", "Dask's scheduler does not answer", kind=RESOURCE, retryable=True) from error

    async def body():
        try:
            async for block in answer.aiter_bytes():
                yield block
        finally:
            await answer.aclose()
            await client.aclose()

    headers = {name: answer.headers[name] for name in _RETURNED if name in answer.headers}
    if answer.is_redirect:
        headers["location"] = PATH + urlsplit(answer.headers["location"]).path
    headers |= {"content-security-policy": _POLICY, "x-frame-options": "SAMEORIGIN"}
    return StreamingResponse(body(), answer.status_code, headers)


@router.websocket(PATH + "/{path:path}")
async def pass_on(websocket: WebSocket, path: str) -> None:
    """Bokeh's messages, both ways, until either side ends. Another site's page gets none, whatever its browser
    sends."""
    from websockets.asyncio.client import connect
    from websockets.exceptions import WebSocketException

    try:
        _visitor(websocket)
        settings = websocket.app.state.settings
        url = _base(settings).replace("http", "ws", 1) + f"/{_checked(path)}?{websocket.url.query}"
    except Problem:
        return await websocket.close(1008)
    if urlsplit(websocket.headers.get("origin", "")).netloc != websocket.headers.get("host"):
        return await websocket.close(1008)
    offered = websocket.scope.get("subprotocols") or None  # bokeh, and its token
    try:
        async with connect(url, subprotocols=offered, max_size=None, proxy=None) as server:  # type: ignore[arg-type]
            await websocket.accept(server.subprotocol)
            await _until_either_ends(_to_server(websocket, server), _to_browser(websocket, server))
    except (OSError, WebSocketException):
        pass
    with suppress(RuntimeError, WebSocketDisconnect):  # it is closed already
        await websocket.close(1001)


async def _to_server(websocket: WebSocket, server) -> None:
    while (message := await websocket.receive())["type"] == "websocket.receive":
        text = message.get("text")
        await server.send(message["bytes"] if text is None else text)


async def _to_browser(websocket: WebSocket, server) -> None:
    async for message in server:
        await (websocket.send_text(message) if isinstance(message, str) else websocket.send_bytes(message))


async def _until_either_ends(*ways) -> None:
    tasks = [asyncio.create_task(way) for way in ways]
    await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
