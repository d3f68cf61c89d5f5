"""What an owner is told depends on no other owner: the same bytes brought by two are two scans to look at."""

from __future__ import annotations

import hashlib

import pytest
from fastapi.testclient import TestClient

from services.api.app import create_app
from services.jobs.runner import tidy
from services.settings import settings_from
from services.uploads import scans as uploads_scans
from tests.services.scans import point_scan


@pytest.fixture(scope="module")
def ball(tmp_path_factory) -> bytes:
    return point_scan(tmp_path_factory.mktemp("ball") / "ball.ply", 50).read_bytes()


@pytest.fixture
def api(tmp_path):
    (tmp_path / "data").mkdir()
    app = create_app(settings_from({}, data=tmp_path / "data", reserve_bytes=0, host="0.0.0.0", retention_s=100))
    with TestClient(app, base_url="http://scans.example") as client:
        yield client


@pytest.fixture
def who(api):
    return {n: {"Authorization": f"Bearer {api.app.state.store.add_token(n)}"} for n in ("ann", "bob", "cyd")}


def bring(api, who: dict, name: str, content: bytes):
    return api.post("/v1/scans", files={"file": (name, content)}, headers=who)


def without_times(document: dict) -> dict:
    return {k: v for k, v in document.items() if k not in ("created", "expires_at")}


def test_owners__bytes_that_another_has_are_answered_as_if_nobody_had(api, who, ball):
    alone = bring(api, who["ann"], "mine.ply", ball)
    second = bring(api, who["bob"], "mine.ply", ball)
    assert alone.status_code == second.status_code == 201
    assert without_times(alone.json()) == without_times(second.json())
    third = bring(api, who["cyd"], "secret plan.ply", ball)
    assert third.status_code == 201 and third.json()["file"] == "secret plan.ply" and "mine" not in third.text
    assert api.get(f"/v1/scans/{third.json()['id']}", headers=who["bob"]).json()["file"] == "mine.ply"
    assert bring(api, who["bob"], "again.ply", ball).status_code == 200  # who brought it himself


def test_owners__the_reader_looks_again_for_another(api, who, ball, monkeypatch):
    """Else the time of the answer would tell."""
    read = []
    real = uploads_scans.validated_header
    monkeypatch.setattr(uploads_scans, "validated_header", lambda *a: read.append(1) or real(*a))
    bring(api, who["ann"], "a.ply", ball)
    bring(api, who["bob"], "b.ply", ball)
    assert len(read) == 2


def test_owners__what_anothers_job_measured_is_not_shown(api, who, ball):
    scan = bring(api, who["ann"], "a.ply", ball).json()["id"]
    bring(api, who["bob"], "b.ply", ball)
    api.app.state.store.note_of_scan(
        scan, "ann", bounds={"min": [0, 0, 0], "max": [9, 9, 9]}, effects=[{"effect": "x"}]
    )
    found = {n: api.get(f"/v1/scans/{scan}", headers=who[n]).json() for n in ("ann", "bob")}
    assert found["ann"]["bounds"]["max"] == [9, 9, 9]
    assert found["bob"]["effects"] is None and found["bob"]["bounds"] != found["ann"]["bounds"]


def test_owners__a_scan_that_one_deletes_stays_for_the_other_and_goes_with_the_last(api, who, ball):
    data = api.app.state.settings.data
    scan = bring(api, who["ann"], "a.ply", ball).json()["id"]
    bring(api, who["bob"], "b.ply", ball)
    assert api.delete(f"/v1/scans/{scan}", headers=who["cyd"]).status_code == 404
    assert api.delete(f"/v1/scans/{scan}", headers=who["ann"]).status_code == 204
    assert api.delete(f"/v1/scans/{scan}", headers=who["ann"]).status_code == 404
    assert api.get("/v1/scans", headers=who["ann"]).json()["numberMatched"] == 0
    assert api.get(f"/v1/scans/{scan}", headers=who["bob"]).status_code == 200
    assert (data / "scans" / scan / "scan.ply").read_bytes() == ball
    assert api.delete(f"/v1/scans/{scan}", headers=who["bob"]).status_code == 204
    assert not (data / "scans" / scan).exists()


def test_owners__a_scan_is_not_deleted_under_a_job(api, who, ball):
    scan = bring(api, who["ann"], "a.ply", ball).json()["id"]
    job = api.post("/v1/jobs", json={"scan": scan}, headers=who["ann"]).json()["jobID"]
    refused = api.delete(f"/v1/scans/{scan}", headers=who["ann"])
    assert refused.status_code == 409 and "under way" in refused.json()["detail"]
    api.delete(f"/v1/jobs/{job}", headers=who["ann"])
    assert api.delete(f"/v1/scans/{scan}", headers=who["ann"]).status_code == 204
    assert (api.app.state.settings.data / "scans" / scan).exists()  # the job needs it, should it be tried again


def test_owners__ones_scan_expires_though_anothers_is_newer(api, who, ball):
    scan = bring(api, who["ann"], "a.ply", ball).json()["id"]
    bring(api, who["bob"], "b.ply", ball)
    store = api.app.state.store
    with store.engine.begin() as connection:
        connection.exec_driver_sql("UPDATE scan_owners SET created = created - 1000 WHERE owner = 'ann'")
    tidy(api.app.state.settings, store)
    statuses = [api.get(f"/v1/scans/{scan}", headers=who[n]).status_code for n in ("ann", "bob")]
    assert statuses == [404, 200] and scan == hashlib.sha256(ball).hexdigest()
