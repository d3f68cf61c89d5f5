"""The reference client of tus against the service: chunked, parallel, deferred, resumed after the death of either
side."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import threading
import time
from pathlib import Path

import pytest

from tests.services.scans import padded_scan
from tests.services.service_process import ApiProcess, until

SCRIPT = Path(__file__).with_name("tus_client.cjs")
MIB = 1 << 20


@pytest.fixture(scope="module")
def large(tmp_path_factory) -> Path:
    """A scan of 20 MB."""
    return padded_scan(tmp_path_factory.mktemp("large"), 20)


@pytest.fixture
def api(tmp_path):
    started = ApiProcess(tmp_path / "data", reserve_bytes="0")
    yield started
    started.kill()


class Node:
    def __init__(self, modules: Path, api: ApiProcess, file: Path, storage: Path) -> None:
        self._modules, self._api, self._file, self._storage = modules, api, file, storage

    def start(self, **options) -> subprocess.Popen:
        command = ["node", str(SCRIPT), self._api.url, str(self._file), str(self._storage), json.dumps(options)]
        environment = {**os.environ, "NODE_PATH": str(self._modules)}
        return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    def run(self, **options) -> list[dict]:
        said, complaints = self.start(**options).communicate(timeout=300)
        rows = [json.loads(line) for line in said.splitlines()]
        assert rows, complaints
        return rows


@pytest.fixture
def node(modules, api, large, tmp_path) -> Node:
    return Node(modules, api, large, tmp_path / "urls.json")


def is_whole(rows: list[dict], large: Path, scan_told: bool = True) -> None:
    assert rows[-1].get("done"), rows
    if scan_told:
        assert rows[-1]["scan"] == hashlib.sha256(large.read_bytes()).hexdigest()


def is_there(api: ApiProcess, large: Path) -> bool:
    return (api.data / "scans" / hashlib.sha256(large.read_bytes()).hexdigest() / "scan.zip").is_file()


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"chunkSize": 3 * MIB},
        {"uploadDataDuringCreation": True, "chunkSize": 6 * MIB},
        {"uploadDataDuringCreation": True},
        {"uploadLengthDeferred": True, "stream": True, "chunkSize": 5 * MIB},
        {"overridePatchMethod": True, "chunkSize": 8 * MIB},
        {"parallelUploads": 3},
        {"parallelUploads": 4, "chunkSize": 2 * MIB},
    ],
    ids=json.dumps,
)
def test_tus_js__every_way_to_upload_that_is_advertised_ends_in_a_scan(node, api, large, options):
    rows = node.run(**options)
    is_whole(rows, large)
    assert is_there(api, large) and not list((api.data / "uploads").iterdir())
    assert all(row["status"] < 300 for row in rows if "status" in row), rows
    if options.get("overridePatchMethod"):
        assert {row["method"] for row in rows if "method" in row} == {"POST"}


def test_tus_js__goes_on_after_it_was_stopped(node, api, large):
    assert node.run(chunkSize=2 * MIB, slowMs=50, stopAt=7 * MIB)[-1]["stopped"]
    rows = node.run(chunkSize=2 * MIB, previous=True)
    assert rows[0] == {"found": 1} and rows[1]["method"] == "HEAD" and int(rows[1]["offset"]) >= 4 * MIB
    is_whole(rows, large)
    assert is_there(api, large)


def on_disk(api: ApiProcess) -> int:
    return sum(p.stat().st_size for p in (api.data / "uploads").rglob("*.zip"))


def test_tus_js__goes_on_after_it_was_killed(node, api, large):
    process = node.start(chunkSize=2 * MIB, slowMs=300)
    until(lambda: on_disk(api) >= 6 * MIB)
    process.kill()
    process.communicate()
    rows = node.run(chunkSize=2 * MIB, previous=True)
    assert rows[0] == {"found": 1} and int(rows[1]["offset"]) >= 6 * MIB
    is_whole(rows, large)


@pytest.mark.parametrize(
    "options", [{"chunkSize": 2 * MIB}, {"parallelUploads": 2, "chunkSize": 2 * MIB}], ids=json.dumps
)
def test_tus_js__goes_on_though_the_api_is_killed_and_started_anew(node, api, large, options):
    process = node.start(**options, slowMs=300)
    until(lambda: sum(p.stat().st_size for p in (api.data / "uploads").rglob("*") if p.is_file()) >= 6 * MIB)
    api.kill()
    time.sleep(0.5)
    restarted = threading.Thread(target=api.start)
    restarted.start()
    said, complaints = process.communicate(timeout=300)
    restarted.join()
    rows = [json.loads(line) for line in said.splitlines()]
    assert rows[-1].get("done"), (rows[-5:], complaints)
    assert is_there(api, large)
