"""The service from Python: upload, submit, watch, status, logs, cancel, retry, fetch, ls.

with Client("http://127.0.0.1:8000") as client:
    job = client.submit(client.upload(Path("scan.zip"))["id"], preset="draft")
    job = client.watch(job["jobID"], lambda event: print(event["data"]))
    client.fetch(job["jobID"], Path("results"))
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import tempfile
import time
import zipfile
from base64 import b64encode
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx

from storage.errors import SplatpressError

PIECE_BYTES = 8 << 20
TRIES = 8  # of a request that found no server or no database behind it: both may be starting anew
ENDED = ("successful", "failed", "dismissed")
_TUS = {"Tus-Resumable": "1.0.0"}


class ServiceError(SplatpressError):
    """What the service answered; `problem` is its RFC 9457 body."""

    def __init__(self, status: int, problem: dict) -> None:
        super().__init__(f"service answered {status}", problem.get("detail", ""), "", problem.get("hint", ""))
        self.status, self.problem = status, problem
        self.kind = problem.get("class", "internal")
        self.exit_code = {"data": 3, "resource": 2}.get(self.kind, 4)

    def __reduce__(self):
        return type(self), (self.status, self.problem)


class Client:
    """One service, one owner. Every verb raises ServiceError for a refusal, httpx.TransportError for no answer."""

    def __init__(self, url: str, token: str | None = None, http: httpx.Client | None = None) -> None:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        self._http = http or httpx.Client(base_url=url, headers=headers, timeout=60)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_) -> None:
        self._http.close()

    def upload(self, scan: Path, on_progress: Callable[[int, int], None] = lambda sent, total: None) -> dict:
        """Upload a file, or a folder as a .zip made on the way; goes on where it was cut off. Returns the scan."""
        if not scan.is_dir():
            return self._upload_file(scan, scan.name, on_progress)
        with tempfile.TemporaryDirectory() as folder:
            packed = Path(folder) / (scan.resolve().name + ".zip")
            zip_folder(scan, packed)
            return self._upload_file(packed, packed.name, on_progress)

    def _upload_file(self, path: Path, name: str, on_progress: Callable[[int, int], None]) -> dict:
        length = path.stat().st_size
        made = self._ask(
            "POST",
            "/v1/uploads",
            headers={
                **_TUS,
                "Upload-Length": str(length),
                "Upload-Metadata": "filename " + b64encode(name.encode()).decode(),
            },
        )
        where = httpx.URL(made.headers["Location"]).path
        offset, scan = 0, None
        with open(path, "rb") as stream:
            while scan is None:
                stream.seek(offset)
                piece = stream.read(PIECE_BYTES)
                offset, scan = self._send(where, offset, piece)
                on_progress(offset, length)
        return self._ask("GET", f"/v1/scans/{scan}").json()

    def _send(self, where: str, offset: int, piece: bytes) -> tuple[int, str | None]:
        """One piece; the server's offset afterwards, whatever became of the connection."""
        checksum = "sha256 " + b64encode(hashlib.sha256(piece).digest()).decode()
        try:
            answer = self._once(
                "PATCH",
                where,
                content=piece,
                timeout=600,
                headers={
                    **_TUS,
                    "Upload-Offset": str(offset),
                    "Upload-Checksum": checksum,
                    "Content-Type": "application/offset+octet-stream",
                },
            )
        except httpx.TransportError:
            answer = self._ask("HEAD", where, headers=_TUS)
        except ServiceError as error:
            if error.status not in (409, 423, 460, 503):
                raise
            time.sleep(0.5)
            answer = self._ask("HEAD", where, headers=_TUS)
        return int(answer.headers["Upload-Offset"]), answer.headers.get("Splatpress-Scan")

    def submit(self, scan: str, *, key: str | None = None, **request) -> dict:
        """A job on a scan: preset, options, seed, name, webhook. Sent again after a lost answer it is still one job."""
        headers = {"Idempotency-Key": key or secrets.token_hex(16)}
        return self._ask("POST", "/v1/jobs", json={"scan": scan, **request}, headers=headers).json()

    def estimate(self, scan: str, preset: str, **options) -> dict:
        """What a job would take; the first time it is asked for, a pilot runs."""
        return self._ask(
            "GET", "/v1/jobs/estimate", params={"scan": scan, "preset": preset, **options}, timeout=600
        ).json()

    def status(self, job: str) -> dict:
        return self._ask("GET", f"/v1/jobs/{job}").json()

    def ls(self, **filters) -> list[dict]:
        return self._ask("GET", "/v1/jobs", params=filters).json()["jobs"]

    def cancel(self, job: str) -> dict:
        return self._ask("DELETE", f"/v1/jobs/{job}").json()

    def retry(self, job: str) -> dict:
        return self._ask("POST", f"/v1/jobs/{job}/retry").json()

    def logs(self, job: str, level: str = "info") -> Iterator[dict]:
        offset = 0
        while True:
            page = self._ask(
                "GET", f"/v1/jobs/{job}/logs", params={"offset": offset, "level": level, "limit": 1000}
            ).json()
            yield from page["logs"]
            if page["next_offset"] == offset:
                return
            offset = page["next_offset"]

    def watch(self, job: str, on_event: Callable[[dict], None]) -> dict:
        """Hear each event of a job once, `{id, kind, data}`, until it has ended; returns it. Survives lost
        connections."""
        last = "0"
        for attempt in range(10**9):
            try:
                with self._http.stream("GET", f"/v1/jobs/{job}/events", headers={"Last-Event-ID": last}) as answer:
                    _check(answer)
                    for event in _events(answer.iter_lines()):
                        last = event["id"]
                        on_event(event)
            except httpx.TransportError:
                time.sleep(min(5.0, 0.5 * (attempt + 1)))
            except ServiceError as error:
                if error.status != 503:
                    raise
            found = self.status(job)
            if found["status"] in ENDED:
                return found

    def artifacts(self, job: str) -> list[dict]:
        return self._ask("GET", f"/v1/jobs/{job}/artifacts").json()["artifacts"]

    def fetch(self, job: str, out: Path, names: list[str] | None = None) -> list[Path]:
        """All artifacts of a job, or those named, into `out`; each is there whole and with its hash, or not at all."""
        wanted = [a for a in self.artifacts(job) if names is None or a["name"] in names]
        return [self._fetch(a, out / a["name"]) for a in wanted]

    def export(self, job: str, format: str) -> dict:
        """The artifact that is the job's packed file as `format`, once the service has made it."""
        while not (
            found := self._ask("GET", f"/v1/jobs/{job}/artifacts", params={"format": format}).json()["artifacts"]
        ):
            time.sleep(0.5)
        return found[0]

    def _fetch(self, artifact: dict, path: Path) -> Path:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(path.name + ".partial")
        for attempt in range(TRIES):
            try:
                self._fetch_rest(artifact, partial)
                break
            except httpx.TransportError:
                if attempt == TRIES - 1:
                    raise
                time.sleep(0.5 * (attempt + 1))
        with open(partial, "rb") as stream:
            found = hashlib.file_digest(stream, "sha256").hexdigest()
        if found != artifact["sha256"]:
            partial.unlink()
            raise ServiceError(502, {"detail": f"{artifact['name']} arrived with another hash", "class": "resource"})
        os.replace(partial, path)
        return path

    def _fetch_rest(self, artifact: dict, partial: Path) -> None:
        there = partial.stat().st_size if partial.exists() else 0
        if there >= artifact["bytes"] > 0:
            return
        headers = {"Range": f"bytes={there}-"} if there else {}
        with self._http.stream("GET", artifact["href"], headers=headers) as answer:
            _check(answer)
            with open(partial, "ab" if answer.status_code == 206 else "wb") as stream:
                for block in answer.iter_bytes():
                    stream.write(block)

    def _once(self, method: str, path: str, **request) -> httpx.Response:
        answer = self._http.request(method, path, **request)
        _check(answer)
        return answer

    def _ask(self, method: str, path: str, **request) -> httpx.Response:
        for attempt in range(TRIES):
            try:
                return self._once(method, path, **request)
            except (httpx.ConnectError, ServiceError) as error:
                if attempt == TRIES - 1 or getattr(error, "status", 503) != 503:
                    raise
                time.sleep(0.5 * (attempt + 1))


def _check(answer: httpx.Response) -> None:
    if answer.is_success:
        return
    text = answer.read()
    try:
        problem = json.loads(text)
    except ValueError:
        problem = {"detail": text[:200].decode(errors="replace")}
    raise ServiceError(answer.status_code, problem)


def _events(lines: Iterator[str]) -> Iterator[dict]:
    event: dict = {}
    for line in lines:
        field, _, value = line.partition(": ")
        if line == "" and event.get("data") is not None:
            yield event
            event = {}
        elif field in ("id", "event", "data"):
            event["kind" if field == "event" else field] = json.loads(value) if field == "data" else value


def zip_folder(folder: Path, path: Path) -> None:
    """The same bytes for the same contents: sorted, stored, without dates."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for file in sorted(p for p in folder.rglob("*") if p.is_file() and not p.is_symlink()):
            entry = zipfile.ZipInfo(file.relative_to(folder).as_posix())
            entry.external_attr = 0o644 << 16
            with open(file, "rb") as source, archive.open(entry, "w", force_zip64=True) as target:
                while block := source.read(PIECE_BYTES):
                    target.write(block)
