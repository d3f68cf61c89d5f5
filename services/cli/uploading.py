"""A file to the service by tus, piece by piece; what was cut off goes on where it was, also by another process later.

What is begun is remembered in a file of the user's, by the service's address and a fingerprint of the file: its name,
size, time and first bytes.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from base64 import b64encode
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import httpx

from services.cli.answers import ServiceError

PIECE_BYTES = 8 << 20
PATIENCE_S = 120.0  # for a service that is being started anew, since the last byte that arrived
FIRST_BYTES = 1 << 20
MAX_REMEMBERED = 100
OFFSET_TYPE = "application/offset+octet-stream"
TUS = {"Tus-Resumable": "1.0.0"}
_GONE = (404, 410)
_AGAIN = (408, 409, 423, 429, 460, 503, 507)  # another request was faster, or the service is not well for a moment


class Memory:
    """Where the uploads begun from here stand. A place that cannot be written remembers nothing."""

    def __init__(self, path: Path | None = None) -> None:
        base = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
        self.path = path or Path(base) / "splatpress" / "uploads.json"

    def find(self, key: str) -> str | None:
        return self._read().get(key)

    def note(self, key: str, where: str | None) -> None:
        """The newest stands last; with None it is forgotten."""
        kept = {k: v for k, v in self._read().items() if k != key} | ({key: where} if where else {})
        kept = dict(list(kept.items())[-MAX_REMEMBERED:])
        partial = self.path.with_name(f"{self.path.name}.{os.getpid()}.partial")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            partial.write_text(json.dumps(kept))
            os.replace(partial, self.path)
        except OSError:
            partial.unlink(missing_ok=True)

    def _read(self) -> dict[str, str]:
        try:
            found = json.loads(self.path.read_text())
        except (OSError, ValueError):
            return {}
        return found if isinstance(found, dict) else {}


def fingerprint(path: Path, name: str, changed: float) -> str:
    """The same while the file is the same, as far as its name, size, time and first bytes tell."""
    with open(path, "rb") as stream:
        first = hashlib.sha256(stream.read(FIRST_BYTES)).hexdigest()
    facts = [name, path.stat().st_size, changed, first]
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()


class Uploading:
    """One file on its way. `once(method, path, **request)` asks the service one time, and raises ServiceError or
    httpx.TransportError."""

    def __init__(
        self,
        once: Callable[..., httpx.Response],
        service: str,
        path: Path,
        name: str,
        changed: float,
        memory: Memory,
    ) -> None:
        self._once, self._path, self._name, self._memory = once, path, name, memory
        self._key = f"{service} {fingerprint(path, name, changed)}"
        self.length = path.stat().st_size

    def run(self, on_progress: Callable[[int, int], None]) -> str:
        """The id of the scan that it became.

        Raises: ServiceError for a refusal; httpx.TransportError where there was no answer for PATIENCE_S: to go on
        later takes another call.
        """
        where, offset, scan = self._begun()
        on_progress(offset, self.length)
        since = time.monotonic()
        with open(self._path, "rb") as stream:
            while scan is None:
                before = offset
                try:
                    offset, scan = self._send(where, stream, offset)
                except (httpx.TransportError, ServiceError) as error:
                    offset, scan = self._look_again(where, error, since)
                since = time.monotonic() if offset != before else since
                on_progress(offset, self.length)
        self._memory.note(self._key, None)
        return scan

    def _begun(self) -> tuple[str, int, str | None]:
        """Address and offset: of what was begun before, where the service still knows it."""
        where = self._memory.find(self._key)
        if where is not None:
            try:
                offset, scan = self._head(where)
                if scan is None or self._is_there(scan):
                    return where, offset, scan
            except ServiceError as error:
                if error.status not in _GONE:
                    raise
        name = b64encode(self._name.encode()).decode()
        headers = {**TUS, "Upload-Length": str(self.length), "Upload-Metadata": f"filename {name}"}
        where = httpx.URL(self._once("POST", "/v1/uploads", headers=headers).headers["Location"]).path
        self._memory.note(self._key, where)
        return where, 0, None

    def _is_there(self, scan: str) -> bool:
        try:
            return self._once("GET", f"/v1/scans/{scan}").is_success
        except ServiceError as error:
            if error.status != 404:
                raise
            return False

    def _send(self, where: str, stream: BinaryIO, offset: int) -> tuple[int, str | None]:
        stream.seek(offset)
        piece = stream.read(PIECE_BYTES)
        headers = {
            **TUS,
            "Upload-Offset": str(offset),
            "Upload-Checksum": "sha256 " + b64encode(hashlib.sha256(piece).digest()).decode(),
            "Content-Type": OFFSET_TYPE,
        }
        return _state(self._once("PATCH", where, content=piece, timeout=600, headers=headers))

    def _head(self, where: str) -> tuple[int, str | None]:
        return _state(self._once("HEAD", where, headers=TUS))

    def _look_again(self, where: str, error: Exception, since: float) -> tuple[int, str | None]:
        """Where the upload stands after `error`, whatever became of the connection; raises it where that is no use."""
        for attempt in range(10**9):
            if isinstance(error, ServiceError) and error.status not in _AGAIN:
                self._memory.note(self._key, None)  # refused: the service has discarded it
                raise error
            if time.monotonic() - since > PATIENCE_S:
                raise error
            time.sleep(min(5.0, 0.25 * 2**attempt))
            try:
                return self._head(where)
            except (httpx.TransportError, ServiceError) as again:
                error = again
        raise error


def _state(answer: httpx.Response) -> tuple[int, str | None]:
    return int(answer.headers["Upload-Offset"]), answer.headers.get("Splatpress-Scan")
