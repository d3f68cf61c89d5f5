"""A scan fetched from an address that its owner names, in place of an upload: https, or a bucket that is allowed.

An https address follows the rules of webhooks: public, resolved once, no redirects. With the service's own keys a
bucket would give everybody's objects to anybody, so only what lies below SPLATPRESS_FETCH_FROM is fetched from one.
"""

from __future__ import annotations

import errno
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import unquote

import httpx

from services.addresses import RefusedAddress, check_url, public_address
from services.problems import RESOURCE, Problem
from services.settings import ServiceSettings
from services.store.rows import UploadRow
from services.store.store import Store
from services.uploads.room import upload_path
from services.uploads.scans import safe_name
from services.uploads.tus import LATER
from services.uploads.upload import Looking, accept, begin, discard, said_length
from services.uploads.volumes import check_name
from storage.place import is_remote, objects

TIMEOUT_S = 30.0  # of each step; a body may take as long as it moves
BLOCK_BYTES = 1 << 20
_BEFORE_AND_AFTER = re.compile(r"^[a-z0-9]+://[^/?#]*|[?#].*$")  # the path of an address


def fetch_scan(url: str, name: str, owner: str, settings: ServiceSettings, store: Store) -> str:
    """The id of the scan, which is there and valid. Raises Problem, after which nothing of it is left."""
    file = safe_name(name or unquote(_BEFORE_AND_AFTER.sub("", url)))
    check_name(file)
    upload = begin(owner, file, LATER, "", "", settings, store)
    try:
        with _opened(url, settings) as (length, blocks):
            if length is not None:
                _check_length(length, settings)
                upload = said_length(upload, length, settings, store)
            upload = said_length(upload, _write(upload, blocks, length, settings), settings, store)
        return accept(upload, settings, store).scan
    except RefusedAddress as error:
        raise Problem(422, "refused-url", str(error)) from None
    except httpx.HTTPError as error:
        detail = f"fetching failed ({type(error).__name__}: {error})"
        raise Problem(422, "not-fetched", detail, kind=RESOURCE, retryable=True) from error
    finally:
        discard(upload, settings, store)


def _check_length(length: int, settings: ServiceSettings) -> None:
    if length > settings.max_upload_bytes:
        raise Problem(413, "too-large", f"{length:,} bytes; allowed: {settings.max_upload_bytes:,}")


def _write(upload: UploadRow, blocks: Iterator[bytes], length: int | None, settings: ServiceSettings) -> int:
    """Looked at as it arrives, as an upload is. Returns the number of bytes."""
    path, n_bytes = upload_path(settings, upload), 0
    look: Callable[[int], None] = Looking(path, length or settings.max_upload_bytes, upload, settings)
    try:
        with open(path, "r+b", buffering=0) as stream:
            for block in blocks:
                n_bytes += len(block)
                _check_length(n_bytes, settings)
                stream.write(block)
                look(n_bytes)
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise Problem(507, "disk-full", "no room for this scan", kind=RESOURCE, retryable=True) from error
    return n_bytes


@contextmanager
def _opened(url: str, settings: ServiceSettings) -> Iterator[tuple[int | None, Iterator[bytes]]]:
    """The length, where it is told, and the bytes."""
    if is_remote(url):
        path = _allowed(url, settings)
        found = objects.head(path)
        if found is None:
            raise Problem(422, "no-such-object", f"{url}: there is none")
        yield found.size, objects.blocks(path)
        return
    told = check_url(url, settings.webhook_private)
    if told.scheme != "https" and not settings.webhook_private:
        raise RefusedAddress(f"{told.scheme} is not fetched; allowed: https")
    host, port = told.raw_host.decode("ascii"), told.port or (443 if told.scheme == "https" else 80)
    address = public_address(host, port, settings.webhook_private)
    headers = {"host": told.netloc.decode(), "accept-encoding": "identity"}
    with (
        httpx.Client(timeout=TIMEOUT_S, follow_redirects=False, trust_env=False) as client,
        client.stream(
            "GET", told.copy_with(host=address), headers=headers, extensions={"sni_hostname": host}
        ) as answer,
    ):
        if answer.status_code != 200:
            hint = "redirects are not followed: name where it lies" if answer.is_redirect else ""
            raise Problem(422, "not-fetched", f"{host} answered {answer.status_code}; allowed: 200", hint=hint)
        length = answer.headers.get("content-length", "")
        yield int(length) if length.isdecimal() else None, answer.iter_bytes(BLOCK_BYTES)


def _allowed(url: str, settings: ServiceSettings) -> Path:
    """Raises RefusedAddress for what does not lie below one of the allowed prefixes."""
    path = Path(url)
    allowed = [Path(text.strip()) for text in settings.fetch_from.split(",") if text.strip()]
    below = any(path.is_relative_to(prefix) for prefix in allowed) and not path.is_relative_to(settings.place)
    if not below or ".." in path.parts or len(path.parts) < 3:
        raise RefusedAddress(f"{url}: allowed: objects below {settings.fetch_from or 'no bucket'}")
    return path
