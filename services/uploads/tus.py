"""The words of tus 1.0.0: what a request's headers say. What is wrong with one is answered as the protocol asks."""

from __future__ import annotations

from base64 import b64decode

from starlette.requests import Request

from services.problems import Problem

VERSION = "1.0.0"
TUS = {"Tus-Resumable": VERSION}
EXTENSIONS = (
    "creation",
    "creation-with-upload",
    "creation-defer-length",
    "concatenation",
    "expiration",
    "checksum",
    "termination",
)
ALGORITHMS = ("sha256", "sha1", "md5")
OFFSET_TYPE = "application/offset+octet-stream"
MAX_METADATA, MAX_PARTS = 4000, 64
LATER = -1  # a length that is said with a later request
PART, JOINED = "partial", "final;"


def refusal(status: int, slug: str, detail: str, **how) -> Problem:
    """A problem with the protocol's own header."""
    return Problem(status, slug, detail, **{**how, "headers": {**TUS, **how.get("headers", {})}})


def check_version(request: Request) -> None:
    """Raises: Problem 412 for a request of another version of tus."""
    found = request.headers.get("tus-resumable")
    if request.method not in ("GET", "OPTIONS") and found != VERSION:
        headers = {"Tus-Version": VERSION}
        raise refusal(412, "tus-version", f"Tus-Resumable is {found!r}; allowed: {VERSION}", headers=headers)


def number(request: Request, name: str) -> int:
    """A header that is a whole number. Raises: Problem 400 where it is none."""
    text = request.headers.get(name, "")
    if not (text.isascii() and text.isdigit() and len(text) <= 18):
        raise refusal(400, "wrong-header", f"{name.title()} is {text!r}; allowed: a whole number")
    return int(text)


def length_of(request: Request) -> int:
    """Upload-Length, or LATER where Upload-Defer-Length says so."""
    deferred = request.headers.get("upload-defer-length")
    if deferred is None:
        return number(request, "upload-length")
    if deferred != "1" or "upload-length" in request.headers:
        raise refusal(400, "wrong-header", f"Upload-Defer-Length is {deferred!r}; allowed: 1, without Upload-Length")
    return LATER


def metadata(text: str) -> dict[str, str]:
    """Pairs of a key and a base64 value, with commas between them."""
    if len(text) > MAX_METADATA:
        raise refusal(400, "wrong-header", f"Upload-Metadata of {len(text)} characters; allowed: {MAX_METADATA}")
    pairs = (part.strip().partition(" ") for part in text.split(",") if part.strip())
    try:
        return {key: b64decode(value, validate=True).decode() for key, _, value in pairs}
    except ValueError:
        raise refusal(400, "wrong-header", "Upload-Metadata has a value that is not base64 of UTF-8") from None


def checksum(request: Request) -> tuple[str, bytes] | None:
    """Algorithm and digest of Upload-Checksum; None without it. Raises: Problem 400 where it is not well formed."""
    text = request.headers.get("upload-checksum")
    if text is None:
        return None
    algorithm, _, value = text.partition(" ")
    try:
        digest = b64decode(value, validate=True)
    except ValueError:
        digest = b""
    if algorithm not in ALGORITHMS or not digest:
        allowed = f"{', '.join(ALGORITHMS)} and base64"
        raise refusal(400, "wrong-header", f"Upload-Checksum is {text[:80]!r}; allowed: {allowed}")
    return algorithm, digest


def concat(request: Request) -> str:
    """Upload-Concat: empty, PART, or JOINED and the addresses of the parts."""
    text = request.headers.get("upload-concat", "").strip()
    if text in ("", PART) or (text.startswith(JOINED) and 1 <= len(parts_of(text)) <= MAX_PARTS):
        return text
    allowed = f"partial, or final; and 1 to {MAX_PARTS} addresses"
    raise refusal(400, "wrong-header", f"Upload-Concat is {text[:80]!r}; allowed: {allowed}")


def parts_of(text: str) -> list[str]:
    """The ids of the uploads that Upload-Concat names, whatever host stands before them."""
    return [address.rpartition("/")[2] for address in text.removeprefix(JOINED).split()]
