"""A service as real processes on loopback, for tests: started, looked at, killed in parts."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path

import httpx
import psutil

from services.cli.client import Client
from services.store.store import Store

ROOT = Path(__file__).parent.parent.parent


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def until(what: Callable[[], object], seconds: float = 300.0, every: float = 0.1):
    """The first true answer of `what`."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if found := what():
            return found
        time.sleep(every)
    raise AssertionError(f"not within {seconds:g} s: {what}")


class ServiceProcess:
    def __init__(self, data: Path, port: int, process: subprocess.Popen, log: Path) -> None:
        self.data, self.url, self.process, self.log = data, f"http://127.0.0.1:{port}", process, log
        self.client = Client(self.url)

    def is_ready(self) -> bool:
        assert self.process.poll() is None, self.log.read_text()[-3000:]
        try:
            return httpx.get(self.url + "/readyz").status_code == 200
        except httpx.TransportError:
            return False

    def part(self, name: str) -> psutil.Process | None:
        """The api or the runner."""
        children = psutil.Process(self.process.pid).children()
        return next((p for p in children if name in _command(p)), None)

    def workers(self) -> list[psutil.Process]:
        """Dask's, the render worker among them."""
        runner = self.part("runner")
        return [p for p in runner.children(recursive=True) if "spawn_main" in " ".join(_command(p))] if runner else []

    def render_worker(self) -> psutil.Process:
        """The one that has loaded OpenGL, as it has once it draws."""
        return next(p for p in self.workers() if "libEGL" in Path(f"/proc/{p.pid}/maps").read_text())

    def kill(self, process: psutil.Process) -> None:
        process.send_signal(signal.SIGKILL)

    def event(self, job: str, kind: str, is_it: Callable[[dict], bool]) -> dict:
        """Wait for an event of a job."""
        found: list[dict] = []

        class Found(Exception):
            pass

        def look(event: dict) -> None:
            if event["kind"] == kind and is_it(event["data"]):
                found.append(event["data"])
                raise Found

        try:
            ended = self.client.watch(job, look)
        except Found:
            return found[0]
        raise AssertionError(f"the job is {ended['status']}, without such an event: {ended['problem']}")

    def log_of(self, job: str) -> str:
        return "\n".join(line["message"] for line in self.client.logs(job, "debug"))


def _command(process: psutil.Process) -> list[str]:
    try:
        return process.cmdline()
    except psutil.Error:
        return []


@contextmanager
def service(data: Path, workers: int = 2, log: Path | None = None, **settings: str):
    """`splatpress serve`, ready; ends with all its parts. It runs in the folder that holds `data`, which it is told by
    a relative path, as users do."""
    port, log = free_port(), log or data.with_name(data.name + ".log")
    environment = {
        **os.environ,
        **{f"SPLATPRESS_{name.upper()}": value for name, value in settings.items()},
        "PYTHONPATH": str(ROOT),
    }
    with open(log, "w") as stream:
        process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "services.cli.main",
                "serve",
                "--data",
                data.name,
                "--port",
                str(port),
                "--workers",
                str(workers),
            ],
            env=environment,
            stdout=stream,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            cwd=data.parent,
        )
    started = ServiceProcess(data, port, process, log)
    try:
        until(started.is_ready)
        yield started
    finally:
        family = psutil.Process(process.pid).children(recursive=True) if process.poll() is None else []
        process.terminate()
        try:
            process.wait(60)
        except subprocess.TimeoutExpired:
            process.kill()
        for left in family:
            try:
                left.kill()
            except psutil.Error:
                pass
    assert not [
        words for words in ("*** Aborted", "Fatal Python error", "leaked semaphore") if words in log.read_text()
    ]


class ApiProcess:
    """`splatpress api` alone, without a runner: started, killed and started again on one port."""

    def __init__(self, data: Path, **settings: str) -> None:
        self.data, self.port, self._settings = data, free_port(), settings
        self.url, self.log = f"http://127.0.0.1:{self.port}", data.with_name(data.name + ".log")
        self.start()

    def start(self) -> None:
        environment = {
            **os.environ,
            **{f"SPLATPRESS_{name.upper()}": value for name, value in self._settings.items()},
            "PYTHONPATH": str(ROOT),
        }
        command = [sys.executable, "-m", "services.cli", "api", "--data", self.data.name, "--port", str(self.port)]
        with open(self.log, "a") as stream:
            self.process = subprocess.Popen(
                command, env=environment, stdout=stream, stderr=subprocess.STDOUT, cwd=self.data.parent
            )
        until(self._answers, every=0.05)

    def _answers(self) -> bool:
        assert self.process.poll() is None, self.log.read_text()[-3000:]
        try:
            return httpx.get(self.url + "/healthz").status_code == 200
        except httpx.TransportError:
            return False

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def token(self, owner: str) -> str:
        store = Store(f"sqlite:///{self.data / 'splatpress.sqlite'}")
        try:
            return store.add_token(owner)
        finally:
            store.close()


@contextmanager
def api_alone(data: Path, **settings: str):
    started = ApiProcess(data, **settings)
    try:
        yield started
    finally:
        started.kill()
