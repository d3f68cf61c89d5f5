"""Faults that need a machine's leave: a full disk, and a worker that the network cuts off. Real processes
throughout."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from tests.services.scans import packed_by_compress, photo_scan
from tests.services.service_process import ROOT, free_port, service, until

OPTIONS = {"dictionary": "own", "target_psnr_db": 32.0, "training_splats": 2000, "iterations": 2}
DISK_BYTES = 96 << 20


def allowed(*command: str) -> bool:
    return shutil.which(command[0]) is not None and subprocess.run(command, capture_output=True).returncode == 0


@pytest.fixture
def small_disk(tmp_path):
    folder = tmp_path / "disk"
    folder.mkdir()
    if not allowed("mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "tmpfs", str(folder)):
        pytest.skip("mounting a small file system is not permitted here")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def test_faults__a_full_disk_fails_the_stage_that_filled_it_and_a_retry_goes_on(small_disk, tmp_path):
    scan = photo_scan(tmp_path / "plane", n_side=80)
    with service(small_disk / "data", log=tmp_path / "log", reserve_bytes="0") as served:
        id = served.client.upload(scan)["id"]
        filler = small_disk / "filler"
        free = shutil.disk_usage(small_disk).free
        with open(filler, "wb") as stream:
            os.posix_fallocate(stream.fileno(), 0, free - (20 << 20))  # patches take 19.7 MB, 8 MB stand by
        job = served.client.submit(id, preset="draft", options=OPTIONS)["jobID"]
        ended = served.client.watch(job, lambda event: None)
        assert ended["status"] == "failed"
        assert ended["problem"]["class"] == "resource" and ended["problem"]["retryable"]
        assert re.search(r"stage resample: No space left on device", ended["problem"]["detail"]), ended["problem"]
        assert str(small_disk) not in ended["problem"]["detail"]
        assert not [p for p in small_disk.rglob("*") if ".partial" in p.name]
        filler.unlink()
        assert served.client.retry(job)["status"] == "accepted"
        assert served.client.watch(job, lambda event: None)["status"] == "successful"
        log = served.log_of(job)
        assert "No space left" in log and log.count("ingest: reused") == 1 and re.search(r"resample: [0-9.]+ s", log)
        served.client.fetch(job, tmp_path / "got", ["plane.splatpress"])
    assert (tmp_path / "got" / "plane.splatpress").read_bytes() == packed_by_compress(scan, tmp_path / "out", OPTIONS)


@pytest.fixture
def network():
    """A network namespace with one cable to this one; yields (its name, our address, our end of the cable)."""
    name, ours, theirs = "splat-cut", "splat-cut0", "splat-cut1"
    if not allowed("ip", "netns", "add", name):
        pytest.skip("network namespaces are not permitted here")
    try:
        for command in (
            f"link add {ours} type veth peer name {theirs} netns {name}",
            f"addr add 10.213.7.1/24 dev {ours}",
            f"link set {ours} up",
            f"-n {name} addr add 10.213.7.2/24 dev {theirs}",
            f"-n {name} link set {theirs} up",
            f"-n {name} link set lo up",
        ):
            if not allowed("ip", *command.split()):
                pytest.skip(f"not permitted here: ip {command}")
        yield name, "10.213.7.1", ours
    finally:
        subprocess.run(["ip", "netns", "delete", name], check=True)


@contextmanager
def process(*command: str, log: Path):
    """Any program; a Dask scheduler gives a silent worker up after 6 s, in place of 300, and the nanny it asks after 3,
    in place of 30."""
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "OMP_NUM_THREADS": "1",
        "DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": "6s",
        "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "3s",
    }
    with open(log, "w") as stream:
        started = subprocess.Popen(command, env=environment, stdout=stream, stderr=subprocess.STDOUT)
    try:
        yield started
    finally:
        started.terminate()
        try:
            started.wait(10)
        except subprocess.TimeoutExpired:
            started.kill()


def test_faults__a_worker_that_is_cut_off_is_given_up_and_what_it_still_does_changes_no_byte(network, tmp_path):
    """It goes on with its task after another has been given the same, and is let back in before the job has ended."""
    namespace, address, cable = network
    options = {**OPTIONS, "iterations": 6}
    scan = photo_scan(tmp_path / "plane", n_side=60)
    scheduler = f"tcp://{address}:{free_port()}"
    dask = [str(Path(sys.executable).with_name("dask"))]
    worker = [*dask, "worker", scheduler, "--nworkers", "1", "--nthreads", "1", "--no-dashboard"]
    with ExitStack() as stack:

        def start(name: str, *command: str):
            return stack.enter_context(process(*command, log=tmp_path / f"{name}.log"))

        start(
            "scheduler",
            *dask,
            "scheduler",
            "--host",
            address,
            "--port",
            scheduler.rpartition(":")[2],
            "--dashboard-address",
            ":0",
        )
        start(
            "far",
            "ip",
            "netns",
            "exec",
            namespace,
            *worker,
            "--resources",
            "CPU=1",
            "--local-directory",
            str(tmp_path / "far"),
        )
        start("drawer", *worker, "--resources", "GL=1", "--local-directory", str(tmp_path / "drawer"))
        served = stack.enter_context(service(tmp_path / "data", scheduler=scheduler, log=tmp_path / "log"))
        job = served.client.submit(served.client.upload(scan)["id"], preset="draft", options=options)["jobID"]
        until(lambda: list((served.data / "work").glob("*/ksvd-update-*")), every=0.002)  # an event would come too late
        subprocess.run(["ip", "link", "set", cable, "down"], check=True)
        start("near", *worker, "--resources", "CPU=1", "--local-directory", str(tmp_path / "near"))
        served.event(job, "learning", lambda data: data["iteration"] == 3)
        subprocess.run(["ip", "link", "set", cable, "up"], check=True)
        events = []
        ended = served.client.watch(job, events.append)
        assert ended["status"] == "successful", ended["problem"]
        assert re.search(r"worker tcp://10\.213\.7\.2:\S+ was lost with 1 tasks of \S+", served.log_of(job))
        assert [e["data"]["status"] for e in events if e["kind"] == "status"] == ["accepted", "running", "successful"]
        served.client.fetch(job, tmp_path / "got", ["plane.splatpress"])
    assert (tmp_path / "got" / "plane.splatpress").read_bytes() == packed_by_compress(scan, tmp_path / "out", options)
