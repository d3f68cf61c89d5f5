"""Files as answers."""

from __future__ import annotations

from fastapi import Request
from fastapi.responses import FileResponse


class SentFile(FileResponse):
    """A file, whole or in ranges, in larger blocks than usual: each is a turn of a thread."""

    chunk_size = 1 << 18


def is_known(request: Request, etag: str) -> bool:
    """Whether If-None-Match names it, weakly compared (RFC 9110, 13.1.2)."""
    named = [tag.strip().removeprefix("W/") for tag in request.headers.get("if-none-match", "").split(",")]
    return etag in named or "*" in named
