"""The service from Python: upload, submit, watch, status, logs, cancel, retry, fetch, ls.

with Client("http://127.0.0.1:8000") as client:
    job = client.submit(client.upload(Path("scan.zip"))["id"], preset="draft")
    job = client.watch(job["jobID"], lambda event: print(event["data"]))
    client.fetch(job["jobID"], Path("results"))
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import secrets
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx

from services.cli.answers import ServiceError, check, checked_name, document
from services.cli.uploading import PIECE_BYTES, Memory, Uploading

TRIES = 8  # of a request that found no server or no database behind it: both may be starting anew
ENDED = ("successful", "failed", "dismissed")


class Client:
    """One service, one owner. Every verb raises ServiceError for a refusal, httpx.TransportError for no answer."""

    def __init__(
        self, url: str, token: str | None = None, http: httpx.Client | None = None, memory: Memory | None = None
    ) -> None:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        self.url, self._http = url, http or httpx.Client(base_url=url, headers=headers, timeout=60)
        self._memory = memory or Memory()
        self._met = False  # whether it answered before: then it may be starting anew, and is waited for

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_) -> None:
        self._http.close()

    def upload(self, scan: Path, on_progress: Callable[[int, int], None] = lambda sent, total: None) -> dict:
        """Upload a file, or a folder as a .zip made on the way; goes on where it was cut off, also where an earlier
        process began it. Returns the scan."""
        if not scan.is_dir():
            return self._upload_file(scan, scan.name, scan.stat().st_mtime, on_progress)
        with tempfile.TemporaryDirectory() as folder:
            packed = Path(folder) / (scan.resolve().name + ".zip")
            zip_folder(scan, packed)
            changed = max((p.stat().st_mtime for p in scan.rglob("*") if p.is_file()), default=0.0)
            return self._upload_file(packed, packed.name, changed, on_progress)

    def fetch_scan(self, url: str) -> dict:
        """Have the service fetch a scan from an https or s3 address. Returns the scan, once it is there."""
        return document(self._ask("POST", "/v1/scans/by-url", json={"url": url}, timeout=None))

    def _upload_file(self, path: Path, name: str, changed: float, on_progress: Callable[[int, int], None]) -> dict:
        scan = Uploading(self._once, self.url, path, name, changed, self._memory).run(on_progress)
        return self._get(f"/v1/scans/{scan}")

    def submit(self, scan: str, *, key: str | None = None, **request) -> dict:
        """A job on a scan: preset, options, seed, name, webhook. Sent again after a lost answer it is still one job."""
        headers = {"Idempotency-Key": key or secrets.token_hex(16)}
        return document(self._ask("POST", "/v1/jobs", json={"scan": scan, **request}, headers=headers))

    def estimate(self, scan: str, preset: str, **options) -> dict:
        """What a job would take; the first time it is asked for, a pilot runs."""
        return self._ask(
            "GET", "/v1/jobs/estimate", params={"scan": scan, "preset": preset, **options}, timeout=600
        ).json()

    def status(self, job: str) -> dict:
        return self._get(f"/v1/jobs/{job}")

    def ls(self, **filters) -> list[dict]:
        return self._get("/v1/jobs", params=filters)["jobs"]

    def cancel(self, job: str) -> dict:
        return document(self._ask("DELETE", f"/v1/jobs/{job}"))

    def retry(self, job: str) -> dict:
        return document(self._ask("POST", f"/v1/jobs/{job}/retry"))

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

    def watch(self, job: str, on_event: Callable[[dict], None]) -> dict:  # type: ignore[return]
        """Hear each event of a job once, `{id, kind, data}`, until it has ended; returns it. Survives lost
        connections."""
        last = "0"
        for attempt in itertools.count():
            try:
                with self._http.stream("GET", f"/v1/jobs/{job}/events", headers={"Last-Event-ID": last}) as answer:
                    check(answer)
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
        return self._get(f"/v1/jobs/{job}/artifacts")["artifacts"]

    def fetch(self, job: str, out: Path, names: list[str] | None = None) -> list[Path]:
        """All artifacts of a job, or those named, into `out`; each is there whole and with its hash, or not at all."""
        wanted = [a for a in self.artifacts(job) if names is None or a["name"] in names]
        paths = [out / checked_name(a["name"]) for a in wanted]  # all of them, before the first is written
        return [self._fetch(a, path) for a, path in zip(wanted, paths, strict=True)]

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
            check(answer)
            with open(partial, "ab" if answer.status_code == 206 else "wb") as stream:
                for block in answer.iter_bytes():
                    stream.write(block)

    def _once(self, method: str, path: str, **request) -> httpx.Response:
        answer = self._http.request(method, path, **request)
        self._met = True
        check(answer)
        return answer

    def _get(self, path: str, **request) -> dict:
        return document(self._ask("GET", path, **request))

    def _ask(self, method: str, path: str, **request) -> httpx.Response:  # type: ignore[return]
        for attempt in itertools.count():
            try:
                return self._once(method, path, **request)
            except (httpx.ConnectError, ServiceError) as error:
                if attempt == TRIES - 1 or not self._met or getattr(error, "status", 503) != 503:
                    raise
                time.sleep(0.5 * (attempt + 1))


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
