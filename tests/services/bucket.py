"""An S3 server on loopback as a plain process, and a proxy before it that stumbles, for tests and measurements."""

from __future__ import annotations

import itertools
import socket
import socketserver
import subprocess
import sys
import threading
from contextlib import contextmanager
from dataclasses import dataclass, field

import pytest

from tests.services.service_process import free_port, until

BUCKET = "scans"
KINDS = ("busy", "cut_before", "cut_after")
CREDENTIALS = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_REGION": "us-east-1"}


def bucket_environment(port: int, host: str = "127.0.0.1") -> dict[str, str]:
    return {**CREDENTIALS, "AWS_ENDPOINT_URL": f"http://{host}:{port}", "AWS_ALLOW_HTTP": "true"}


@contextmanager
def s3_server(host: str = "127.0.0.1"):
    """moto's, with an empty bucket; yields its port."""
    pytest.importorskip("moto", reason="moto[server] is not installed")
    boto3 = pytest.importorskip("boto3")
    port = free_port()
    command = [sys.executable, "-m", "moto.server", "-H", host, "-p", str(port)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        until(lambda: _listens(host, port), every=0.05)
        keys = {"aws_access_key_id": "test", "aws_secret_access_key": "test", "region_name": "us-east-1"}
        boto3.client("s3", endpoint_url=f"http://{host}:{port}", **keys).create_bucket(Bucket=BUCKET)
        yield port
    finally:
        process.kill()
        process.wait()


def _listens(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), 1).close()
        return True
    except OSError:
        return False


@dataclass
class Stumbling:
    """Requests that were answered, answered 503, cut off before the server saw them, and cut off in their answer."""

    port: int
    passed: int = 0
    busy: int = 0
    cut_before: int = 0
    cut_after: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)

    @property
    def stumbles(self) -> int:
        return self.busy + self.cut_before + self.cut_after


@contextmanager
def stumbling_proxy(target: int, every: int = 20):
    """One request in `every` fails, in three ways by turns; a connection carries one request. Which ones fail depends
    on the order in which they arrive, what comes of it does not."""
    numbers, told = itertools.count(1), Stumbling(0)

    class Handler(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            request = _message(self.rfile)
            if request is None:
                return
            with told.lock:
                number = next(numbers)
                kind = KINDS[number // every % len(KINDS)] if number % every == 0 else "passed"
                setattr(told, kind, getattr(told, kind) + 1)
            if kind == "busy":
                self.wfile.write(b"HTTP/1.1 503 Slow Down\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
            if kind in ("busy", "cut_before"):
                return
            with socket.create_connection(("127.0.0.1", target)) as server:
                server.sendall(request)
                answer = b"".join(iter(lambda: server.recv(1 << 20), b""))
            self.wfile.write(answer[: len(answer) // 2] if kind == "cut_after" else answer)

    class Server(socketserver.ThreadingTCPServer):
        daemon_threads, allow_reuse_address, request_queue_size = True, True, 128

    with Server(("127.0.0.1", 0), Handler) as server:
        told.port = server.server_address[1]
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield told
        finally:
            server.shutdown()


def _message(stream) -> bytes | None:
    """One request whole, that asks for its connection to be closed; None where none came."""
    lines = []
    while line := stream.readline():
        if line == b"\r\n":
            break
        lines.append(line)
    if not lines:
        return None
    fields = dict(line.decode("latin-1").lower().split(":", 1) for line in lines[1:])
    body = stream.read(int(fields.get("content-length", 0)))
    kept = [line for line in lines if not line.lower().startswith((b"connection:", b"expect:"))]
    return b"".join([*kept, b"Connection: close\r\n\r\n", body])
