"""RFC 9457 problem details: every error that leaves the service, with whose turn it is and how to mend it."""

from __future__ import annotations

import secrets
import sys

from sqlalchemy.exc import InterfaceError, OperationalError

from storage.errors import SplatpressError

DATA, RESOURCE, INTERNAL = "data", "resource", "internal"


_OGC = "http://www.opengis.net/def/exceptions/ogcapi-processes-1/1.0/"
_OGC_TYPES = {slug: _OGC + slug for slug in ("no-such-process", "no-such-job", "result-not-ready")}


class Problem(Exception):
    """`slug` names the type of the problem, for programs; `kind` says whose turn it is."""

    def __init__(
        self,
        status: int,
        slug: str,
        detail: str,
        *,
        kind: str = DATA,
        retryable: bool = False,
        hint: str = "",
        headers: dict[str, str] | None = None,
    ) -> None:
        super().__init__(detail)
        self.status, self.slug, self.detail, self.kind = status, slug, detail, kind
        self.retryable, self.hint, self.headers = retryable, hint, headers or {}

    def body(self) -> dict:
        return {
            "type": _OGC_TYPES.get(self.slug, f"urn:splatpress:problem:{self.slug}"),
            "title": self.slug.replace("-", " "),
            "status": self.status,
            "detail": self.detail,
            "class": self.kind,
            "retryable": self.retryable,
            **({"hint": self.hint} if self.hint else {}),
        }


def mistake(what: str) -> Problem:
    """For an error of ours: what happened goes into this process's log, and the one who asked hears where it is."""
    id = secrets.token_hex(4)
    print(f"splatpress: mistake {id}: {what}", file=sys.stderr, flush=True)
    return Problem(500, "internal-error", f"a mistake of ours; the log has it as {id}", kind=INTERNAL, retryable=True)


def is_of_database(error: Exception, full: bool = False) -> bool:
    """Whether it is the database that is away; with `full`, whether it is the disk that it lies on."""
    return isinstance(error, (OperationalError, InterfaceError)) and (not full or "full" in str(error.orig))


def problem_of_job(error: Exception) -> dict:
    """What a failed job says of its failure."""
    if isinstance(error, SplatpressError):
        slug = {"data": "bad-scan", "resource": "out-of-resources"}.get(error.kind, "internal-error")
        return Problem(
            422 if error.kind == DATA else 500,
            slug,
            str(error),
            kind=error.kind,
            retryable=error.kind != DATA,
            hint=error.hint,
        ).body()
    if isinstance(error, OSError) and not isinstance(
        error, FileNotFoundError
    ):  # a file of ours that is not there is no want
        return Problem(500, "out-of-resources", error.strerror or f"{error}", kind=RESOURCE, retryable=True).body()
    if is_of_database(error):
        return Problem(
            500, "out-of-resources", f"the database: {getattr(error, 'orig', error)}", kind=RESOURCE, retryable=True
        ).body()
    return Problem(
        500,
        "internal-error",
        f"{type(error).__name__}: {error}",
        kind=INTERNAL,
        retryable=True,
        hint="a mistake of ours; the log has the traceback",
    ).body()
