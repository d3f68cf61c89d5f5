"""The viewer of one packed file on loopback: what `splatpress view` serves."""

from __future__ import annotations

import ipaddress
import re
from pathlib import Path

from fastapi import FastAPI, Request, Response
from fastapi.responses import PlainTextResponse

from services.files import SentFile, is_known
from services.web.viewer_page import PAGE, POLICY, viewer_file
from storage.packed.seal import SEAL, SEAL_BYTES


def viewer_app(packed: Path) -> FastAPI:
    """Pages and the file's bytes in ranges, for names of this machine alone: no page of another site may read them."""
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    etag = f'"{_tag(packed)}"'

    @app.middleware("http")
    async def guarded(request: Request, call_next):
        if not _is_loopback(request.url.hostname or ""):
            return PlainTextResponse("only names of this machine are answered", 403)
        response = await call_next(request)
        response.headers["content-security-policy"] = POLICY
        response.headers["x-content-type-options"] = "nosniff"
        response.headers["cross-origin-resource-policy"] = "same-origin"
        return response

    @app.get("/")
    def page() -> Response:
        return file(PAGE)

    @app.get("/content")
    def content(request: Request) -> Response:
        headers = {"etag": etag, "cache-control": "no-cache"}
        return (
            Response(status_code=304, headers=headers) if is_known(request, etag) else SentFile(packed, headers=headers)
        )

    @app.get("/web/viewer/{name}")
    def file(name: str) -> Response:
        found = viewer_file(name)
        return PlainTextResponse("no such file", 404) if found is None else Response(found[0], media_type=found[1])

    return app


def _tag(packed: Path) -> str:
    """What changes with the contents: the digest that the file is sealed with."""
    size = packed.stat().st_size
    with open(packed, "rb") as file:
        file.seek(max(0, size - SEAL_BYTES))
        digest = file.read().removeprefix(SEAL).decode("ascii", "replace")
    return digest if re.fullmatch("[0-9a-f]{64}", digest) else f"{size}-{packed.stat().st_mtime_ns}"


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
