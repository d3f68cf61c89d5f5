"""Exports that the API is asked for, without a service around: what is kept, what is refused, what a failure says."""

from __future__ import annotations

import shutil

import pytest
from fastapi.testclient import TestClient

from pipeline.exports.formats import FORMATS
from services.api.app import create_app
from services.jobs import exports
from services.jobs.exports import make_next_export
from services.jobs.workflow import job_folder
from services.settings import settings_from
from services.store.rows import RUNNING, SUCCESSFUL, ArtifactRow, NewJob
from storage.errors import ResourceExhausted
from tests.packed_files import Case, write_packed_file

SCAN = "a" * 64


class OneProcess:
    """In place of the link to a scheduler."""

    def __init__(self, *_) -> None:
        pass

    def __enter__(self):
        return self

    def __exit__(self, *_) -> None:
        pass

    def call(self, _, function, *arguments):
        return function(*arguments)


@pytest.fixture
def api(tmp_path, monkeypatch):
    monkeypatch.setattr(exports, "SchedulerLink", OneProcess)
    app = create_app(settings_from({}, data=tmp_path / "data", reserve_bytes=0))
    with TestClient(app, base_url="http://127.0.0.1") as client:
        yield client


def job_in(api, *names: str, status: str = SUCCESSFUL) -> str:
    """A job with packed files of those names among its artifacts."""
    settings, store = api.app.state.settings, api.app.state.store
    job, _ = store.add_job(NewJob("local", SCAN, "tiny", {}, "compress"), 100)
    store.begin(job.id, 1)
    artifacts = []
    for name in names:
        path = job_folder(settings, job.id) / "attempt-1" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(write_packed_file(Case(), path.with_name("made.splatpress")), path)
        artifacts.append(ArtifactRow(name, f"attempt-1/{name}", path.stat().st_size, "0" * 64))
    if status != RUNNING:
        store.end(job.id, 1, status, artifacts)
    return job.id


def make_next(api) -> None:
    make_next_export(api.app.state.settings, api.app.state.store, "tcp://nowhere")


def ask(api, job: str, format: str):
    return api.get(f"/v1/jobs/{job}/artifacts", params={"format": format})


@pytest.mark.parametrize("format", FORMATS)
def test_exports__are_made_once_and_kept(api, format):
    job = job_in(api, "tiny.splatpress")
    assert [ask(api, job, format).status_code for _ in range(3)] == [202, 202, 202]
    make_next(api)
    make_next(api)  # nothing is wanted any more
    found = ask(api, job, format)
    (artifact,) = found.json()["artifacts"]
    assert found.status_code == 200 and artifact["name"] == f"exports/tiny{FORMATS[format].suffix}"
    got = api.get(artifact["href"])
    assert got.status_code == 200 and len(got.content) == artifact["bytes"]
    assert got.headers["etag"] == f'"{artifact["sha256"]}"'
    names = {a["name"] for a in api.get(f"/v1/jobs/{job}/artifacts").json()["artifacts"]}
    assert names == {"tiny.splatpress", artifact["name"]}


def test_exports__of_what_is_not_there(api):
    assert ask(api, job_in(api, "tiny.splatpress"), "obj").status_code == 422
    assert ask(api, job_in(api), "ply").json()["detail"].endswith("has no packed file to make it of")
    assert ask(api, job_in(api, "a.splatpress", "b.splatpress"), "ply").status_code == 404
    assert ask(api, job_in(api, status=RUNNING), "ply").json()["retryable"]
    make_next(api)


def test_exports__a_failure_is_said_once_and_then_tried_again(api, monkeypatch):
    job = job_in(api, "tiny.splatpress")

    def full(*_):
        raise ResourceExhausted("disk", "no room")

    monkeypatch.setattr(exports, "export", full)
    assert ask(api, job, "ply").status_code == 202
    make_next(api)
    failed = ask(api, job, "ply")
    assert failed.status_code == 500 and failed.json()["class"] == "resource" and "no room" in failed.json()["detail"]
    monkeypatch.undo()
    monkeypatch.setattr(exports, "SchedulerLink", OneProcess)
    assert ask(api, job, "ply").status_code == 202
    make_next(api)
    assert ask(api, job, "ply").status_code == 200


def test_exports__of_a_job_that_is_dismissed_meanwhile_are_no_artifacts(api):
    job = job_in(api, "tiny.splatpress")
    assert ask(api, job, "ply").status_code == 202
    api.delete(f"/v1/jobs/{job}")
    make_next(api)
    assert not api.get(f"/v1/jobs/{job}/artifacts").json()["artifacts"]
