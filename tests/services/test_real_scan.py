"""A real scan over HTTP alone: uploaded, run, watched, fetched, and compared with what `splatpress compress` packs.

Minutes of work, so only where it is asked for: SPLATPRESS_REAL_SCAN=../shared/data/fountain_p11 and, if it is not to be
`draft`, SPLATPRESS_REAL_PRESET=balanced. Prints the seconds of each part.
"""

from __future__ import annotations

import json
import os
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from pipeline.execution.executors import DaskExecutor
from pipeline.planning.settings import settings_for
from services.cli.client import Client
from services.processes.compress import compress
from tests.pipeline.execution.test_stage import Heard
from tests.services.composed import composed_in
from tests.services.service_process import service

SCAN, PRESET = os.environ.get("SPLATPRESS_REAL_SCAN"), os.environ.get("SPLATPRESS_REAL_PRESET", "draft")
pytestmark = pytest.mark.skipif(not SCAN, reason="takes minutes: set SPLATPRESS_REAL_SCAN to a COLMAP workspace")


@contextmanager
def embedded(folder: Path):
    with service(folder / "data") as served:
        yield served.client


@contextmanager
def composed(folder: Path):
    with composed_in(folder, n_workers=2) as made, made.client() as client:
        yield client


@pytest.fixture(scope="module")
def expected(tmp_path_factory) -> dict:
    """Of `splatpress compress`, without previews: they change no byte of the packed file."""
    out = tmp_path_factory.mktemp("expected") / "out"
    with DaskExecutor(2) as executor:
        report = compress(Path(SCAN), out, settings_for(PRESET), executor, Heard(), render=False)
    return {"packed": next(out.glob("*.splatpress")).read_bytes(), "report": report}


@pytest.mark.parametrize("how", [embedded, composed])
def test_real_scan__upload_job_previews_report_and_download_over_http(how, expected, tmp_path, capsys):
    took, events = {}, []
    with how(tmp_path) as client:
        scan = _timed(took, "upload", lambda: client.upload(Path(SCAN)))
        job = client.submit(scan["id"], preset=PRESET)["jobID"]
        ended = _timed(took, "job", lambda: client.watch(job, events.append))
        assert ended["status"] == "successful", ended["problem"]
        _timed(took, "download", lambda: client.fetch(job, tmp_path / "got"))
        _check_artifacts(client, job, tmp_path / "got", scan, expected)
    assert len([e for e in events if e["kind"] == "progress"]) > 10
    with capsys.disabled():
        print(
            f"\n{how.__name__}, {PRESET}, {scan['points']:,} points: "
            + ", ".join(f"{k} {s:.1f} s" for k, s in took.items())
        )


def _timed(took: dict, name: str, what):
    begun = time.perf_counter()
    result = what()
    took[name] = time.perf_counter() - begun
    return result


def _check_artifacts(client: Client, job: str, got: Path, scan: dict, expected: dict) -> None:
    found = {a["name"]: a["bytes"] for a in client.artifacts(job)}
    packed = next(name for name in found if name.endswith(".splatpress"))
    assert (got / packed).read_bytes() == expected["packed"]
    report = json.loads((got / "report.json").read_text())
    assert report["quality"]["texture_psnr_db"] == expected["report"]["quality"]["texture_psnr_db"]
    assert len(report["quality"]["views"]) == min(12, scan["cameras"]["count"])
    assert {"report.html", "learning.json", "dask-performance.html"} <= found.keys()
    assert all((got / name).stat().st_size == size for name, size in found.items())
    assert sum(name.endswith(".packed.png") for name in found) == len(report["quality"]["views"])
