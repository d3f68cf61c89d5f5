"""`serve` and its parts from outside: who may ask, who may look, and how they end."""

from __future__ import annotations

import os
import signal
import socket
import stat
import subprocess
import sys
import time
from pathlib import Path

import httpx
import psutil
import pytest
from fastapi.testclient import TestClient

from pipeline.execution.executors import DaskExecutor
from services.api.app import create_app
from services.cli import serve
from services.cli.answers import ServiceError
from services.cli.client import Client
from services.cli.main import main
from services.jobs.disk import make_data_folder
from services.settings import ServiceSettings, settings_from
from tests.services.service_process import ROOT, ApiProcess, free_port, until


def started(*arguments: str, log: Path, **environment: str) -> subprocess.Popen:
    with open(log, "w") as stream:
        return subprocess.Popen(
            [sys.executable, "-m", "services.cli", *arguments],
            env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
            stdin=subprocess.PIPE,
            stdout=stream,
            stderr=subprocess.STDOUT,
            cwd=log.parent,
            start_new_session=True,
        )


def ended(process: subprocess.Popen, seconds: float = 60) -> int:
    try:
        return process.wait(seconds)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        raise


def test_serve__says_what_a_group_does_next_and_from_where(tmp_path):
    data = tmp_path / "Grüße an alle"
    alone = ServiceSettings(data=data, port=8123)
    assert [line for line in serve._next_steps(alone, serve.address(alone)) if "token" in line] == []
    group = ServiceSettings(data=data, port=8123, host="0.0.0.0")
    elsewhere, tokens, then = serve._next_steps(group, serve.address(group))
    assert f"http://{socket.gethostname()}:8123/" in elsewhere and f"--data '{data}'" in tokens
    assert then.endswith(f"login --url http://{socket.gethostname()}:8123")


def test_serve__a_second_one_on_a_folder_is_refused_by_name_of_the_first(tmp_path):
    port = str(free_port())
    first = started("serve", "--data", "d", "--port", port, "--workers", "1", log=tmp_path / "first.log")
    try:
        until(lambda: (tmp_path / "d" / "serve.lock").exists() and (tmp_path / "d" / "serve.lock").read_text())
        until(lambda: (tmp_path / "first.log").read_text().startswith("starting; addresses stand here"))
        log = tmp_path / "second.log"
        assert ended(started("serve", "--data", "d", "--port", str(free_port()), log=log)) == 2
        said = log.read_text()
        assert f"by process {first.pid} of {socket.gethostname()} at http://127.0.0.1:{port}" in said
        assert len(said.splitlines()) == 1 and "Traceback" not in said
    finally:
        first.terminate()
        assert ended(first) == 0
    with socket.create_server(("127.0.0.1", 0)) as taken:
        busy = str(taken.getsockname()[1])
        assert ended(started("serve", "--data", "d", "--port", busy, log=tmp_path / "third.log")) == 2
    assert "already in use; take another with --port" in (tmp_path / "third.log").read_text()
    assert "is served already" not in (tmp_path / "third.log").read_text()


def test_serve__a_part_that_cannot_start_is_given_up_and_says_why_in_a_line(tmp_path):
    log = tmp_path / "log"
    process = started(
        "serve",
        "--data",
        "d",
        "--port",
        str(free_port()),
        log=log,
        SPLATPRESS_DATABASE="postgresql://a:b@127.0.0.1:1/c",
    )
    assert ended(process, 300) == 2
    said = log.read_text()
    assert "resource error: the database does not answer" in said and "5 times right after its start" in said
    assert not any(word in said for word in ("Traceback", "Fatal Python error", "*** Aborted", "please report"))


def test_runner__one_that_waits_for_another_ends_at_once_and_without_a_dump(tmp_path):
    import fcntl

    make_data_folder(ServiceSettings(data=tmp_path / "d"))
    with open(tmp_path / "d" / "runner.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        log = tmp_path / "log"
        process = started("runner", "--data", "d", "--end-with-stdin", log=log)
        maps = Path(f"/proc/{process.pid}/maps")
        until(lambda: "pycolmap" in maps.read_text())
        time.sleep(2)  # until it waits
        process.terminate()
        assert ended(process) == 0
        assert log.read_text() == ""


def test_compress__dask_listens_on_loopback_alone():
    with DaskExecutor(1):
        mine = psutil.Process()
        listening = [
            c for p in (mine, *mine.children(recursive=True)) for c in p.net_connections("inet") if c.status == "LISTEN"
        ]
    assert len(listening) >= 3 and {c.laddr.ip for c in listening} <= {"127.0.0.1", "::1"}


def test_data__a_folder_made_here_is_its_owners_alone(tmp_path):
    make_data_folder(ServiceSettings(data=tmp_path / "a" / "data"))
    assert stat.S_IMODE((tmp_path / "a" / "data").stat().st_mode) == 0o700


@pytest.mark.parametrize("name", ["X-Forwarded-For", "Forwarded", "X-Real-IP", "Via", "X-Forwarded-Proto"])
def test_api__behind_a_proxy_a_token_is_needed_on_loopback_too(tmp_path, name):
    make_data_folder(ServiceSettings(data=tmp_path / "data"))
    with TestClient(create_app(settings_from({}, data=tmp_path / "data")), base_url="http://127.0.0.1") as api:
        assert api.get("/v1/jobs").status_code == 200
        assert api.get("/v1/jobs", headers={name: "for=1.2.3.4"}).status_code == 401
        token = api.app.state.store.add_token("ann")
        assert api.get("/v1/jobs", headers={name: "1.2.3.4", "Authorization": f"Bearer {token}"}).status_code == 200


def test_api__tokens_may_be_required_on_loopback(tmp_path, monkeypatch):
    api = ApiProcess(tmp_path / "data", require_tokens="true")
    try:
        assert httpx.get(api.url + "/v1/jobs").status_code == 401
        with Client(api.url, api.token("ann")) as client:
            assert client.ls() == []
    finally:
        api.kill()


EVIL = [
    "../../evil",
    "/etc/evil",
    "a/../../evil",
    "..",
    "C:\\evil",
    "\\\\host\\evil",
    "a//b",
    "./a",
    "C:/evil",
    "a\x00b",
    "",
]


@pytest.mark.parametrize("name", EVIL)
def test_fetch__a_servers_artifact_name_leads_nowhere_but_into_the_folder(tmp_path, name):
    def answer(request: httpx.Request) -> httpx.Response:
        names = ["good.txt", name]
        rows = [{"name": n, "bytes": 1, "sha256": "0" * 64, "href": "/x"} for n in names]
        return (
            httpx.Response(200, json={"artifacts": rows})
            if "artifacts" in request.url.path
            else httpx.Response(200, content=b"x")
        )

    http = httpx.Client(transport=httpx.MockTransport(answer), base_url="http://evil.example")
    out = tmp_path / "a" / "out"
    with Client("http://evil.example", http=http) as client, pytest.raises(ServiceError, match="leaves the folder"):
        client.fetch("0" * 32, out)
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == []


@pytest.mark.parametrize(
    ("content", "kind"), [(b"<html>hello</html>", "text/html"), (b"[]", "application/json"), (b"", "text/plain")]
)
@pytest.mark.parametrize("status", [200, 404, 500])
def test_client__a_foreign_server_is_named_as_such(tmp_path, capsys, monkeypatch, content, kind, status):
    import http.server
    import threading

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(status)
            self.send_header("content-type", kind)
            self.send_header("content-length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_) -> None:
            pass

    server = http.server.HTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    url = f"http://127.0.0.1:{server.server_port}"
    try:
        assert main(["ls", "--url", url]) == 2
    finally:
        server.shutdown()
        server.server_close()
    said = capsys.readouterr().err
    assert f"{url}/ is no splatpress service" in said and kind in said and "internal" not in said


@pytest.mark.parametrize(
    "verb", [("ls",), ("status", "0" * 32), ("fetch", "0" * 32, "--out", "x"), ("upload", "SCAN"), ("watch", "0" * 32)]
)
def test_client__an_offline_service_is_told_with_its_address(tmp_path, capsys, verb):
    (tmp_path / "scan.ply").write_bytes(b"ply")
    url = f"http://127.0.0.1:{free_port()}"
    assert main([*(str(tmp_path / "scan.ply") if v == "SCAN" else v for v in verb), "--url", url]) == 2
    said = capsys.readouterr().err
    assert f"no answer from {url}/" in said and len(said.splitlines()) == 1
