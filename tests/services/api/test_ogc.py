"""Clients of the standards: OWSLib runs a job end to end; HTTP's own words (Allow, HEAD, ETag) are spoken."""

from __future__ import annotations

import hashlib
import io
import re
import time
import zipfile

import pytest
from fastapi.testclient import TestClient

from services.api.app import create_app
from services.cli.main import main
from services.settings import settings_from
from services.store.rows import ArtifactRow
from services.store.store import Store
from tests.services.scans import photo_scan, point_scan
from tests.services.service_process import service


@pytest.fixture(scope="module")
def api(tmp_path_factory):
    folder = tmp_path_factory.mktemp("api")
    (folder / "data").mkdir()
    with TestClient(
        create_app(settings_from({}, data=folder / "data", reserve_bytes=0)), base_url="http://127.0.0.1"
    ) as client:
        yield client


@pytest.fixture(scope="module")
def scan(api, tmp_path_factory) -> str:
    ball = point_scan(tmp_path_factory.mktemp("ball") / "ball.ply", 50).read_bytes()
    return api.post("/v1/scans", files={"file": ("ball.ply", ball)}).json()["id"]


@pytest.fixture(scope="module")
def ended(api, scan) -> str:
    """A job that has made two files."""
    store, data = api.app.state.store, api.app.state.settings.data
    id = api.post("/v1/jobs", json={"scan": scan, "name": "two files"}).json()["jobID"]
    rows = []
    for name, content in (("report.json", b"{}"), ("previews/0000.packed.png", b"\x89PNG" * 100_000)):
        path = data / "jobs" / id / "attempt-1" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        hash = hashlib.sha256(content).hexdigest()
        rows.append(ArtifactRow(name, f"attempt-1/{name}", len(content), hash))
    store.begin(id, 1)
    store.end(id, 1, "successful", rows)
    return id


def test_ogc__owslib_runs_a_job_end_to_end(tmp_path):
    from owslib.ogcapi.processes import Processes

    with service(tmp_path / "data", workers=1) as served:
        scan = served.client.upload(photo_scan(tmp_path / "plane", n_side=24))["id"]
        client = Processes(served.url + "/v1/")
        assert any(name.endswith("/conf/core") for name in client.conformance()["conformsTo"])
        assert [p["id"] for p in client.processes()] == ["compress", "tradeoff"]
        described = client.process("compress")
        assert described["inputs"]["scan"]["minOccurs"] == 1 and described["inputs"]["preset"]["schema"]["default"]
        inputs = {"scan": scan, "preset": "draft", "options": {"iterations": 1, "training_splats": 500}}
        status = client.execute("compress", inputs, async_=True)
        assert status["status"] == "accepted" and client.response_headers["location"] == f"/v1/jobs/{status['jobID']}"
        deadline = time.monotonic() + 300
        while status["status"] in ("accepted", "running"):
            assert time.monotonic() < deadline
            time.sleep(0.3)
            status = client._request(path=f"jobs/{status['jobID']}")
        assert status["status"] == "successful", status["problem"]
        results = client._request(path=f"jobs/{status['jobID']}/results")
        assert results["report.html"]["type"] == "text/html"
        href = results["plane.splatpress"]["href"]
        whole, head = served.client._http.get(href), served.client._http.head(href)
        assert whole.status_code == 200 and len(whole.content) == int(head.headers["content-length"]) > 1000


def test_ogc__wrong_executions_name_the_input(api, scan):
    run = lambda id, **body: api.post(f"/v1/processes/{id}/execution", json=body)
    assert run("guess", inputs={}).status_code == 404 and "no-such-process" in run("guess", inputs={}).json()["type"]
    assert re.search(r"inputs\.scan", run("compress", inputs={}).json()["detail"])
    assert re.search(r"inputs\.preset", run("compress", inputs={"scan": scan, "preset": "fast"}).json()["detail"])
    assert run("compress", inputs={"scan": scan, "colour": 1}).status_code == 422
    assert run("tradeoff", inputs={"scan": scan, "knobs": {"iterations": [1, 3]}}).json()["processID"] == "tradeoff"


def test_ogc__results_come_when_they_are_there(api, scan, ended):
    early = api.post("/v1/jobs", json={"scan": scan}).json()["jobID"]
    answer = api.get(f"/v1/jobs/{early}/results")
    assert answer.status_code == 404 and answer.json()["type"].endswith("/result-not-ready")
    assert api.get(f"/v1/jobs/{'0' * 32}").json()["type"].endswith("/no-such-job")
    api.delete(f"/v1/jobs/{early}")
    assert api.get(f"/v1/jobs/{early}/results").status_code == 410
    found = api.get(f"/v1/jobs/{ended}/results").json()
    assert found["report.json"] == {"href": f"/v1/jobs/{ended}/artifacts/report.json", "type": "application/json"}
    links = {link["rel"] for link in api.get(f"/v1/jobs/{ended}").json()["links"]}
    assert "http://www.opengis.net/def/rel/ogc/1.0/results" in links


def test_http__a_wrong_method_is_told_all_right_ones(api, scan):
    for path, allowed in (
        ("/v1/jobs", "GET, HEAD, POST"),
        (f"/v1/scans/{scan}", "DELETE, GET, HEAD"),
        ("/v1/options", "GET, HEAD"),
    ):
        answer = api.put(path)
        assert answer.status_code == 405 and answer.headers["allow"] == allowed, (path, answer.headers.get("allow"))


def test_http__head_is_get_without_its_body(api, scan, ended):
    for path in (
        "/v1/jobs",
        f"/v1/scans/{scan}",
        "/",
        "/v1/options",
        f"/v1/jobs/{ended}/artifacts/report.json",
        "/healthz",
    ):
        whole, head = api.get(path), api.head(path)
        assert head.status_code == whole.status_code == 200 and head.content == b""
        assert head.headers["content-length"] == whole.headers["content-length"] == str(len(whole.content))
    assert api.head("/v1/jobs/nothing").status_code == 422


def test_http__what_is_known_is_not_sent_again(api, ended):
    path = f"/v1/jobs/{ended}/artifacts/previews/0000.packed.png"
    etag = api.get(path).headers["etag"]
    for known in (etag, f"W/{etag}", f'"other", {etag}', "*"):
        answer = api.get(path, headers={"If-None-Match": known})
        assert answer.status_code == 304 and answer.content == b"" and answer.headers["etag"] == etag
    assert api.get(path, headers={"If-None-Match": '"other"'}).status_code == 200


def test_archive__holds_every_artifact_and_is_streamed(api, ended):
    with api.stream("GET", f"/v1/jobs/{ended}/archive") as answer:
        assert answer.status_code == 200 and "two files.zip" in answer.headers["content-disposition"].replace(
            "%20", " "
        )
        content = b"".join(answer.iter_bytes())
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert archive.testzip() is None
        assert set(archive.namelist()) == {"report.json", "previews/0000.packed.png"}
        assert archive.read("previews/0000.packed.png") == b"\x89PNG" * 100_000


def test_openapi__says_who_may_ask_and_what_tus_wants(api):
    document = api.get("/v1/openapi.json").json()
    assert (
        document["components"]["securitySchemes"]["token"]["scheme"] == "bearer"
        and {"token": []} in document["security"]
    )
    assert document["paths"]["/healthz"]["get"]["security"] == []
    patch = document["paths"]["/v1/uploads/{id}"]["patch"]
    assert {"Upload-Offset", "Upload-Checksum", "Tus-Resumable"} <= {p["name"] for p in patch["parameters"]}
    assert "application/offset+octet-stream" in patch["requestBody"]["content"]
    assert "Upload-Offset" in patch["responses"]["204"]["headers"]
    assert (
        "head" in document["paths"]["/v1/uploads/{id}"]
        and "head" in document["paths"]["/v1/jobs/{id}/artifacts/{name}"]
    )


# --- owners' tokens


def test_tokens__are_listed_revoked_and_expire(tmp_path):
    (tmp_path / "data").mkdir()
    app = create_app(settings_from({}, data=tmp_path / "data", host="0.0.0.0"))
    with TestClient(app, base_url="http://scans.example") as api:
        ann, bob = ({"Authorization": f"Bearer {app.state.store.add_token(name)}"} for name in ("ann", "bob"))
        made = api.post("/v1/tokens", json={"label": "laptop", "days": 1}, headers=ann).json()
        mine = {"Authorization": f"Bearer {made['token']}"}
        assert api.get("/v1/jobs", headers=mine).status_code == 200
        rows = api.get("/v1/tokens", headers=ann).json()["tokens"]
        assert [row["label"] for row in rows] == ["", "laptop"] and rows[1]["expires"] and rows[1]["used"]
        assert made["token"] not in api.get("/v1/tokens", headers=ann).text
        assert api.delete(f"/v1/tokens/{made['id']}", headers=bob).status_code == 404
        assert api.delete(f"/v1/tokens/{made['id']}", headers=ann).status_code == 204
        assert api.get("/v1/jobs", headers=mine).status_code == 401
        short = api.post("/v1/tokens", json={"days": 1e-6}, headers=ann).json()["token"]
        time.sleep(0.2)
        assert api.get("/v1/jobs", headers={"Authorization": f"Bearer {short}"}).status_code == 401
        actions = [row["action"] for row in api.get("/v1/audit", headers=ann).json()["actions"]]
        assert actions == ["POST tokens", "DELETE tokens", "POST tokens"]
        assert api.get("/v1/audit", headers=bob).json()["actions"] == []


def test_jobs__are_found_by_words_of_their_name_and_renamed(api, scan):
    id = api.post("/v1/jobs", json={"scan": scan, "name": "Old Bridge, north side"}).json()["jobID"]
    names = lambda q: [job["name"] for job in api.get("/v1/jobs", params={"q": q}).json()["jobs"]]
    assert names("bridge NORTH") == ["Old Bridge, north side"] and names("bridge south") == [] and names("%") == []
    assert api.patch(f"/v1/jobs/{id}", json={"name": "New bridge"}).json()["name"] == "New bridge"
    assert names("new") == ["New bridge"] and api.patch(f"/v1/jobs/{id}", json={"name": ""}).status_code == 422


def test_token__the_command_line_makes_lists_and_revokes(tmp_path, capsys):
    run = lambda *words: (main(["token", "ann", "--data", str(tmp_path), *words]), capsys.readouterr().out)
    code, made = run("--label", "laptop", "--days", "2")
    store = Store(f"sqlite:///{tmp_path / 'splatpress.sqlite'}")
    assert code == 0 and store.owner_of(made.strip()) == "ann"
    code, listed = run("--list")
    assert code == 0 and "laptop" in listed and made.strip() not in listed
    assert run("--revoke", listed.split()[0])[0] == 0 and store.owner_of(made.strip()) is None
    assert run("--revoke", listed.split()[0])[0] == 1
    store.close()
