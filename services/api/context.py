"""What every endpoint needs: settings, store, and who is asking."""

from __future__ import annotations

import ipaddress
from typing import Annotated

from fastapi import Depends, Path, Request
from starlette.requests import HTTPConnection

from services.problems import Problem
from services.settings import LOOPBACK, ServiceSettings
from services.store.rows import JobRow
from services.store.store import Store

LOCAL_OWNER = "local"
# What proxies add: who asks through one stands somewhere else, wherever this process listens
_FORWARDED = {"forwarded", "via", "x-forwarded-for", "x-forwarded-host", "x-forwarded-proto", "x-real-ip"}


def settings_of(request: Request) -> ServiceSettings:
    """The service's settings, of any request."""
    return request.app.state.settings


def store_of(request: Request) -> Store:
    """The service's store, of any request."""
    return request.app.state.store


def owner_of(request: Request) -> str:
    """The owner of the bearer token; on a service bound to loopback, of no token too.

    Without a token the Host must name loopback, else any web page could have a browser send requests here under a name
    of its own that it lets point to 127.0.0.1.
    """
    owner = owner_of_connection(request)
    site = request.headers.get("sec-fetch-site", "none")
    has_token = bool(request.headers.get("authorization", "").partition(" ")[2])
    if not has_token and request.method not in ("GET", "HEAD", "OPTIONS") and site not in ("none", "same-origin"):
        raise Problem(403, "foreign-site", "without a token, only this service's own page may change anything")
    request.state.owner = owner
    return owner


def owner_of_connection(connection: HTTPConnection, cookie: str = "") -> str:
    """As `owner_of`, of what changes nothing; a token may also have come as the value of a `cookie`."""
    scheme, _, token = connection.headers.get("authorization", f"Bearer {cookie}").partition(" ")
    if token:
        owner = connection.app.state.store.owner_of(token.strip()) if scheme.lower() == "bearer" else None
        if owner is None:
            raise _unauthorised("the token is not known, or no longer good")
        return owner
    if connection.app.state.settings.needs_tokens or _FORWARDED & set(connection.headers.keys()):
        raise _unauthorised("no token")
    if not _is_loopback(connection.url.hostname or ""):
        raise Problem(403, "foreign-host", "without a token, only requests to a loopback name are answered")
    return LOCAL_OWNER


def _unauthorised(detail: str) -> Problem:
    return Problem(
        401,
        "no-token",
        detail,
        hint="send Authorization: Bearer TOKEN; `splatpress token OWNER` makes one",
        headers={"WWW-Authenticate": "Bearer"},
    )


def _is_loopback(host: str) -> bool:
    try:
        return host in LOOPBACK or ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


Settings = Annotated[ServiceSettings, Depends(settings_of)]
Database = Annotated[Store, Depends(store_of)]
Owner = Annotated[str, Depends(owner_of)]
Hash = Annotated[str, Path(pattern="^[0-9a-f]{64}$")]
JobID = Annotated[str, Path(pattern="^[0-9a-f]{32}$")]


def job_of(id: JobID, owner: Owner, store: Database) -> JobRow:
    """A job of one's own; another's is as unknown as none."""
    job = store.job(id, owner)
    if job is None:
        raise Problem(404, "no-such-job", f"no job {id}")
    return job


Job = Annotated[JobRow, Depends(job_of)]
