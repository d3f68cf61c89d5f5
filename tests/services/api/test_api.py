"""The API in one process, without a runner: what it refuses, what it remembers, and that refusals leave nothing."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import io
import re
import stat
import struct
import time
import zipfile
from pathlib import Path

import httpx
import pytest
import schemathesis
from fastapi.testclient import TestClient
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi import checks

from pipeline.planning.settings import Settings
from services.addresses import RefusedAddress
from services.api.app import create_app
from services.cli.client import zip_folder
from services.jobs.runner import tidy
from services.problems import Problem
from services.settings import settings_from
from services.store.rows import RUNNING, ArtifactRow
from services.uploads import by_url
from services.uploads.early_checks import Look, look
from services.uploads.validation import validated_header
from storage.version import VERSION
from tests.pipeline.readers.workspace import write_ply
from tests.services.scans import photo_scan, point_scan

TUS = {"Tus-Resumable": "1.0.0"}
PATCH = {**TUS, "Content-Type": "application/offset+octet-stream"}


def app_for(folder: Path, **changes):
    (folder / "data").mkdir(exist_ok=True)
    return create_app(settings_from({}, data=folder / "data", reserve_bytes=0, **changes))


@pytest.fixture(scope="module")
def api(tmp_path_factory):
    app = app_for(
        tmp_path_factory.mktemp("api"), max_multipart_bytes=4 << 20, max_upload_bytes=8 << 20, max_jobs_in_flight=1000
    )
    with TestClient(app, base_url="http://127.0.0.1", raise_server_exceptions=False) as client:
        yield client


@pytest.fixture(scope="module")
def workspace(tmp_path_factory) -> bytes:
    folder = tmp_path_factory.mktemp("scan")
    zip_folder(photo_scan(folder / "plane", n_side=12), folder / "plane.zip")
    return (folder / "plane.zip").read_bytes()


@pytest.fixture(scope="module")
def ball(tmp_path_factory) -> bytes:
    return point_scan(tmp_path_factory.mktemp("ball") / "ball.ply", 50).read_bytes()


@pytest.fixture(scope="module")
def scan(api, ball) -> str:
    return api.post("/v1/scans", files={"file": ("ball.ply", ball)}).json()["id"]


def files_of(api) -> set[Path]:
    data = api.app.state.settings.data
    return {p for p in data.rglob("*") if p.is_file() and not p.name.startswith(("splatpress.sqlite", "scans.lock"))}


def problem(answer, status: int, words: str) -> dict:
    body = answer.json()
    assert answer.status_code == status, (answer.status_code, body)
    assert answer.headers["content-type"] == "application/problem+json" and body["status"] == status
    assert {"type", "title", "detail", "class", "retryable"} <= body.keys()
    assert re.search(words, body["detail"]), body["detail"]
    assert "/data/" not in body["detail"] and "Traceback" not in body["detail"]
    return body


# --- scans


def test_api__a_scan_is_known_by_its_content(api, workspace):
    first = api.post("/v1/scans", files={"file": ("plane.zip", workspace)})
    again = api.post("/v1/scans", files={"file": ("other name.zip", workspace)})
    assert (first.status_code, again.status_code) == (201, 200)
    assert first.json()["id"] == again.json()["id"] == hashlib.sha256(workspace).hexdigest()
    found = api.get(first.headers["location"]).json()
    assert (
        found["points"] == 144
        and found["cameras"]["count"] == 3
        and found["path"] == "plane.zip"
        and "textures" in found["calls_for"][0]
    )
    assert found["effects"] is None  # until a job has measured it


def _zip(*entries: tuple[str, bytes], mode: int = 0o644) -> bytes:
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries:
            entry = zipfile.ZipInfo(name)
            entry.external_attr, entry.compress_type = mode << 16, zipfile.ZIP_DEFLATED
            archive.writestr(entry, content)
    return made.getvalue()


def _with_member(workspace: bytes, name: str, content: bytes) -> bytes:
    with zipfile.ZipFile(io.BytesIO(workspace)) as archive:
        members = {n: archive.read(n) for n in archive.namelist()}
    assert name in members
    return _zip(*(members | {name: content}).items())


def _overlapping(workspace: bytes) -> bytes:
    """Every entry of the directory points at the largest member's bytes."""
    data = bytearray(workspace)
    at, offsets = 0, []
    while (at := data.find(b"PK\x01\x02", at)) >= 0:
        offsets.append(at)
        at += 4
    largest = max(offsets, key=lambda o: struct.unpack_from("<I", data, o + 20)[0])
    sizes = bytes(data[largest + 16 : largest + 28])
    for o in offsets:
        data[o + 16 : o + 28] = sizes
    return bytes(data)


BAD = {
    "empty file": ("a.ply", lambda w: b"", 422, "empty file"),
    "no scan": ("a.obj", lambda w: b"v 0 0 0", 415, "allowed: a COLMAP"),
    "zip slip": ("a.zip", lambda w: _zip(("../../evil.txt", b"x")), 422, "leaves the archive"),
    "absolute name": ("a.zip", lambda w: _zip(("/etc/evil", b"x")), 422, "leaves the archive"),
    "symlink": ("a.zip", lambda w: _zip(("images", b"/etc"), mode=stat.S_IFLNK | 0o777), 422, "symbolic link"),
    "bomb": ("a.zip", lambda w: _zip(("fused.ply", bytes(50_000_000))), 422, "unpacked"),
    "nested bomb": (
        "a.zip",
        lambda w: _zip(("a.zip", _zip(("b", bytes(20_000_000))))),
        422,
        "sparse|cameras|fused|images",
    ),
    "overlapping": ("a.zip", _overlapping, 422, "overlap|unpacked"),
    "a billion points": (
        "a.ply",
        lambda w: (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 1000000000\nproperty float x\n"
            b"property float y\nproperty float z\nend_header\n" + bytes(120)
        ),
        422,
        "a.ply",
    ),
    "too large": ("a.ply", lambda w: bytes(5 << 20), 413, "more than"),
}


@pytest.mark.parametrize("case", BAD)
def test_api__bad_scans_are_refused_and_leave_nothing_behind(api, workspace, case):
    name, make, status, words = BAD[case]
    before, listed = files_of(api), api.get("/v1/scans").json()
    problem(api.post("/v1/scans", files={"file": (name, make(workspace))}), status, words)
    assert files_of(api) == before and api.get("/v1/scans").json() == listed


def test_api__an_archive_cut_anywhere_is_refused(api, workspace, monkeypatch):
    """Twenty places; the check runs in this process, for twenty new ones would take a minute."""
    from services.uploads import validation

    monkeypatch.setattr(validation, "validated_header", None)
    limits = {
        "max_archive_files": 1000,
        "max_unpacked_bytes": 1 << 30,
        "max_archive_ratio": 100,
        "max_photo_pixels": 10**8,
    }
    folder = api.app.state.settings.data.parent
    for i in range(20):
        path = folder / "cut.zip"
        path.write_bytes(workspace[: len(workspace) * i // 20])
        assert validation._answer(path, limits)["problem"]["status"] == 422


def test_api__points_without_any_position_are_refused_and_some_are_warned_of(api, tmp_path):
    import numpy as np

    positions = np.full((20, 3), np.nan)
    write_ply(tmp_path / "nan.ply", positions, np.ones((20, 3)), np.zeros((20, 3), np.uint8))
    problem(api.post("/v1/scans", files={"file": ("nan.ply", (tmp_path / "nan.ply").read_bytes())}), 422, "finite")
    positions[:15] = 1.0
    write_ply(tmp_path / "some.ply", positions, np.ones((20, 3)), np.zeros((20, 3), np.uint8))
    answer = api.post("/v1/scans", files={"file": ("some.ply", (tmp_path / "some.ply").read_bytes())})
    assert answer.status_code == 201 and any(
        "5 of the first 20" in w and "finite" in w for w in answer.json()["warnings"]
    )


def test_api__a_reader_that_crashes_is_our_mistake_and_the_log_has_it(tmp_path, workspace, capfd):
    """With 64 MB not even the readers' libraries load."""
    app = app_for(tmp_path, validation_memory_bytes=64 << 20)
    with TestClient(app, base_url="http://127.0.0.1") as small:
        body = problem(small.post("/v1/scans", files={"file": ("plane.zip", workspace)}), 500, "a mistake of ours")
        assert body["class"] == "internal" and body["retryable"] and "plane.zip" not in body["detail"]
        id = re.search(r"the log has it as ([0-9a-f]{8})", body["detail"])[1]
        assert re.search(rf"mistake {id}: .*exit status", capfd.readouterr().err)
        assert small.get("/healthz").status_code == 200 and not files_of(small)


def test_api__a_scan_that_the_validator_cannot_find_is_our_mistake(tmp_path, capfd):
    with pytest.raises(Problem) as raised:
        validated_header(tmp_path / "gone.ply", settings_from({}, data=tmp_path))
    assert (raised.value.kind, raised.value.status) == ("internal", 500) and "gone.ply" not in raised.value.detail
    assert "No such file" in capfd.readouterr().err


def test_api__a_validator_that_runs_out_of_time_says_so(tmp_path, workspace):
    (tmp_path / "plane.zip").write_bytes(workspace)
    with pytest.raises(Problem) as raised:
        validated_header(tmp_path / "plane.zip", settings_from({}, data=tmp_path, validation_s=0.05))
    assert raised.value.kind == "data" and "longer than 0.05 s" in raised.value.detail


def test_api__a_relative_data_folder_takes_scans(tmp_path, monkeypatch, workspace, ball):
    monkeypatch.chdir(tmp_path)
    settings = settings_from({})
    assert (
        settings.data == tmp_path / "splatpress-data"
        and settings_from({"SPLATPRESS_DATA": "a/../b"}).data == tmp_path / "b"
    )
    assert settings_from({}, data=Path("here")).data == tmp_path / "here"
    settings.data.mkdir()
    with TestClient(create_app(settings_from({}, reserve_bytes=0)), base_url="http://127.0.0.1") as api:
        for name, content in (("plane.zip", workspace), ("ball.ply", ball)):
            answer = api.post("/v1/scans", files={"file": (name, content)})
            assert answer.status_code == 201, answer.text


# --- uploads


def begin(api, content: bytes, name: str = "ball.ply", **headers) -> str:
    answer = api.post(
        "/v1/uploads",
        headers={
            **TUS,
            "Upload-Length": str(len(content)),
            "Upload-Metadata": "filename " + base64.b64encode(name.encode()).decode(),
            **headers,
        },
    )
    assert answer.status_code == 201, answer.text
    return answer.headers["location"]


def test_api__tus_uploads_in_pieces_become_a_scan(api, ball):
    where, at = begin(api, ball), len(ball) // 3
    first = api.patch(where, content=ball[:at], headers={**PATCH, "Upload-Offset": "0"})
    assert first.status_code == 204 and first.headers["upload-offset"] == str(at)
    head = api.head(where, headers=TUS)
    assert (
        head.headers["upload-offset"] == str(at)
        and head.headers["upload-length"] == str(len(ball))
        and head.headers["cache-control"] == "no-store"
    )
    checksum = "sha1 " + base64.b64encode(hashlib.sha1(ball[at:]).digest()).decode()
    last = api.patch(where, content=ball[at:], headers={**PATCH, "Upload-Offset": str(at), "Upload-Checksum": checksum})
    assert last.status_code == 204 and last.headers["splatpress-scan"] == hashlib.sha256(ball).hexdigest()
    assert api.get(where).json()["scan"] == last.headers["splatpress-scan"]


def test_api__tus_says_what_it_can_do(api):
    answer = api.options("/v1/uploads")
    assert (
        answer.status_code == 204
        and answer.headers["tus-version"] == "1.0.0"
        and answer.headers["tus-max-size"] == str(8 << 20)
    )
    assert {"creation", "checksum", "expiration", "termination"} <= set(answer.headers["tus-extension"].split(","))


def test_api__tus_refuses_by_its_own_statuses(api, ball):
    where = begin(api, ball)
    send = lambda headers, content=ball: api.patch(where, content=content, headers=headers)
    problem(send({**PATCH, "Upload-Offset": "5"}), 409, "allowed: 0")
    problem(send({**PATCH, "Tus-Resumable": "0.2", "Upload-Offset": "0"}), 412, "allowed: 1.0.0")
    problem(send({**TUS, "Content-Type": "text/plain", "Upload-Offset": "0"}), 415, "offset\\+octet-stream")
    problem(send({**PATCH, "Upload-Offset": "0"}, ball + b"more"), 413, "Upload-Length")
    offset = api.head(where, headers=TUS).headers["upload-offset"]
    wrong = "sha256 " + base64.b64encode(bytes(32)).decode()
    if offset != "0":
        where = begin(api, ball)
    problem(send({**PATCH, "Upload-Offset": "0", "Upload-Checksum": wrong}), 460, "Upload-Checksum")
    assert api.head(where, headers=TUS).headers["upload-offset"] == "0"
    problem(send({**PATCH, "Upload-Offset": "0", "Upload-Checksum": "crc32 AAAA"}), 400, "allowed: sha256")
    assert (
        api.post(
            "/v1/uploads", headers={**TUS, "Upload-Length": str(9 << 20), "Upload-Metadata": "filename YS5wbHk="}
        ).status_code
        == 413
    )
    assert (
        api.post(
            "/v1/uploads", headers={**TUS, "Upload-Length": "9", "Upload-Metadata": "filename YS5vYmo="}
        ).status_code
        == 415
    )
    assert api.delete(where, headers=TUS).status_code == 204 and api.head(where, headers=TUS).status_code == 404


def test_api__an_expired_upload_is_gone_and_then_swept(tmp_path, ball):
    with TestClient(app_for(tmp_path, upload_expires_s=0.01), base_url="http://127.0.0.1") as api:
        where = begin(api, ball)
        time.sleep(0.05)
        assert api.head(where, headers=TUS).status_code == 410
        tidy(api.app.state.settings, api.app.state.store)
        assert api.head(where, headers=TUS).status_code == 404 and not files_of(api)


def test_api__a_bad_upload_is_refused_with_its_last_byte_and_leaves_nothing(api):
    before, content = files_of(api), _zip(("../evil", b"x"))
    where = begin(api, content, "evil.zip")
    problem(
        api.patch(where, content=content, headers={**PATCH, "Upload-Offset": "0"}), 422, "evil.zip.*leaves the archive"
    )
    assert api.head(where, headers=TUS).status_code == 404 and files_of(api) == before


BILLION = b"ply\nformat binary_little_endian 1.0\nelement vertex 1000000000\nproperty float x\nend_header\n"
EARLY = {
    "a photo that is called a scan": ("a.ply", lambda: b"\x89PNG\r\n\x1a\n" + bytes(99), "begins with"),
    "no zip": ("a.zip", lambda: bytes(99), "begins with"),
    "no las": ("a.las", lambda: b"LASX" + bytes(400), "begins with"),
    "no e57": ("a.e57", lambda: bytes(99), "begins with"),
    "a billion points": ("a.ply", lambda: BILLION, "1,000,000,000 vertex promised, which need 4,000,000,0.. bytes"),
    "a billion points in a zip": (
        "a.zip",
        lambda: _zip(("s/fused.ply", BILLION))[:-30],
        "a.zip/s/fused.ply:header: 1,000,000,000 vertex",
    ),
    "las of a billion": (
        "a.las",
        lambda: bytearray(b"LASF").ljust(96, b"\0") + struct.pack("<IIBHI", 375, 0, 0, 20, 10**9).ljust(279, b"\0"),
        "a.las:point_count: 1,000,000,000 points promised",
    ),
    "a name that escapes": ("a.zip", lambda: _zip(("ok", b"x"), ("../evil", b"x")), "leaves the archive"),
    "a member beyond the end": (
        "a.zip",
        lambda: struct.pack("<4s5H3I2H", b"PK\3\4", 20, 0, 0, 0, 0, 0, 4 << 30 - 1, 9, 1, 0) + b"ab",
        "bytes promised",
    ),
    "a bomb": (
        "a.zip",
        lambda: struct.pack("<4s5H3I2H", b"PK\3\4", 20, 0, 8, 0, 0, 0, 99, 0xFFFFFFF0, 1, 0) + b"a" + bytes(99),
        "unpacked for one",
    ),
}


@pytest.mark.parametrize("case", EARLY)
def test_api__a_wrong_beginning_is_refused_at_once(api, case):
    """Of 6 MB promised, no more than the first few bytes are sent; in one piece, and split in the middle of a
    header."""
    name, make, words = EARLY[case]
    content, before = bytes(make()), files_of(api)
    for pieces in ([content], [content[: len(content) // 3], content[len(content) // 3 :]]):
        where = begin(api, bytes(6 << 20), name)
        at = 0
        for piece in pieces:
            answer = api.patch(where, content=piece, headers={**PATCH, "Upload-Offset": str(at)})
            at += len(piece)
            if answer.status_code != 204:
                break
        problem(answer, 422, words)
        assert api.head(where, headers=TUS).status_code == 404 and files_of(api) == before


def test_api__a_multipart_body_with_a_wrong_beginning_is_not_read_to_its_end(api):
    sent = []

    async def body():
        yield b'--b\r\nContent-Disposition: form-data; name="file"; filename="a.ply"\r\n\r\n'
        for _ in range(40):
            sent.append(1)
            yield BILLION.ljust(50_000, b"\0") if len(sent) == 1 else bytes(50_000)
        yield b"\r\n--b--\r\n"

    async def post():
        transport = httpx.ASGITransport(api.app)  # unlike the test client it hands blocks on one by one
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
            return await client.post(
                "/v1/scans", content=body(), headers={"Content-Type": "multipart/form-data; boundary=b"}
            )

    problem(asyncio.run(post()), 422, "a.ply:header: 1,000,000,000 vertex promised")
    assert len(sent) < 10


def test_api__a_body_without_a_length_is_counted(api):
    blocks = (bytes(1 << 20) for _ in range(6))
    answer = api.post("/v1/scans", content=blocks, headers={"Content-Type": "multipart/form-data; boundary=b"})
    problem(answer, 413, "more than")


@settings(max_examples=150, deadline=None, database=None, suppress_health_check=list(HealthCheck))
@given(cuts=st.lists(st.integers(0, 10**6), max_size=4))
def test_early_checks__a_good_scan_is_let_through_however_it_is_cut(workspace, ball, cuts):
    for name, content in (("a.zip", workspace), ("a.ply", ball)):
        done = Look()
        for n in sorted({c % (len(content) + 1) for c in cuts} | {len(content)}):
            done = look(io.BytesIO(content[:n]), n, len(content), name, done, settings_from({}))
        assert done.at is None


# --- jobs


def test_api__a_job_has_ogc_fields_and_a_key_makes_it_one(api, scan):
    request = {"scan": scan, "preset": "draft", "options": {"iterations": 2}}
    first = api.post("/v1/jobs", json=request, headers={"Idempotency-Key": "k1"})
    again = api.post("/v1/jobs", json=request, headers={"Idempotency-Key": "k1"})
    assert first.status_code == again.status_code == 201 and first.json() == again.json()
    job = api.get(first.headers["location"]).json()
    assert (
        job["status"] == "accepted"
        and job["progress"] == 0
        and job["type"] == "process"
        and job["settings"]["iterations"] == 2
    )
    assert {"jobID", "created", "started", "finished", "updated"} <= job.keys()
    problem(
        api.post("/v1/jobs", json={**request, "seed": 1}, headers={"Idempotency-Key": "k1"}), 422, "another request"
    )


@pytest.mark.parametrize(
    ("change", "status", "words"),
    [
        ({"options": {"dictionary_bits": 7}}, 422, "allowed: auto, 8, 9, 10, 11, 12, 13, 14, 16"),
        ({"options": {"colour": 1}}, 422, "colour"),
        ({"options": {"target_psnr_db": "NaN"}}, 422, "target_psnr_db"),
        ({"preset": "fast"}, 422, "preset"),
        ({"scan": "0" * 64}, 422, "no scan"),
        ({"scan": "../.."}, 422, "scan"),
        ({"seed": -1}, 422, "seed"),
        ({"webhook": "http://127.0.0.1/x"}, 422, "private"),
        ({"webhook": "http://[::ffff:10.0.0.1]/"}, 422, "private"),
        ({"webhook": "http://169.254.169.254/"}, 422, "private"),
        ({"webhook": "ftp://example.org/"}, 422, "http"),
        ({"webhook": "http://localhost:80/"}, 422, "private"),
        ({"name": "a\x00b"}, 422, "name"),
        ({"process": "guess"}, 422, "process"),
        ({"knobs": {"iterations": [1]}}, 422, "knobs are varied by 'tradeoff' alone"),
        ({"process": "tradeoff", "knobs": {"speed": [1]}}, 422, "'speed' is no knob"),
        ({"budget_s": 0}, 422, "budget_s"),
        ({"process": "tradeoff", "knobs": {"weight_bits": [4, 7]}}, 422, "weight_bits is 7; allowed: 4, 5, 6, 8"),
    ],
)
def test_api__wrong_requests_name_the_field_and_what_it_allows(api, scan, change, status, words):
    problem(api.post("/v1/jobs", json={"scan": scan, **change}), status, words)


def test_api__a_tradeoff_is_a_process_of_its_own(api, scan):
    job = api.post(
        "/v1/jobs", json={"scan": scan, "process": "tradeoff", "knobs": {"iterations": [1, 3]}, "budget_s": 60}
    ).json()
    assert job["processID"] == "tradeoff" and job["settings"] == api.get("/v1/presets").json()[1]["settings"]
    assert api.post("/v1/jobs", json={"scan": scan}).json()["processID"] == "compress"


def test_api__an_estimate_is_made_once_and_then_known(api, scan, monkeypatch):
    found = api.get("/v1/jobs/estimate", params={"scan": scan, "preset": "draft", "iterations": 2})
    assert found.status_code == 200 and found.json()["splats"] == 50 and found.json()["seconds"]["value"] > 0
    monkeypatch.setattr("services.api.estimates._pilot", None)  # there is none to be made
    assert (
        api.get("/v1/jobs/estimate", params={"scan": scan, "preset": "draft", "iterations": 2}).json() == found.json()
    )


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"preset": "fast"}, "preset is 'fast'"),
        ({"iterations": "0"}, "iterations is 0; allowed: whole numbers, 1 to 1,000"),
        ({"colour": "1"}, "'colour' is no option"),
        ({"scan": "0" * 64}, "no scan"),
        ({"scan": "x"}, "scan"),
        ({"radius": "--help"}, "radius is --help"),
    ],
)
def test_api__an_estimate_of_nothing_allowed_is_refused(api, scan, parameters, words):
    problem(api.get("/v1/jobs/estimate", params={"scan": scan, **parameters}), 422, words)


def test_api__jobs_are_filtered_and_paged(api, scan):
    for i in range(3):
        api.post("/v1/jobs", json={"scan": scan, "name": f"page {i}"})
    page = api.get("/v1/jobs", params={"status": "accepted", "scan": scan, "limit": 2}).json()
    assert (
        [j["name"] for j in page["jobs"]] == ["page 2", "page 1"]
        and page["numberMatched"] >= 3
        and page["numberReturned"] == 2
    )
    assert api.get("/v1/jobs", params={"status": "failed"}).json()["jobs"] == []


def test_api__dismissing_twice_is_410_and_retry_keeps_log_and_creation_date(api, scan):
    store = api.app.state.store
    job = api.post("/v1/jobs", json={"scan": scan}).json()
    where = f"/v1/jobs/{job['jobID']}"
    problem(api.post(where + "/retry"), 409, "accepted")
    problem(api.get(where + "/artifacts/report.json"), 404, "yet")
    store.log(job["jobID"], "info", "kept")
    assert api.delete(where).json()["status"] == "dismissed"
    problem(api.delete(where), 410, "dismissed before")
    again = api.post(where + "/retry")
    assert (
        again.status_code == 202 and again.json()["status"] == "accepted" and again.json()["created"] == job["created"]
    )
    assert [line["message"] for line in api.get(where + "/logs").json()["logs"]] == ["kept"]


def test_api__deleting_a_job_that_has_ended_removes_its_artifacts_unless_it_is_pinned(api, scan):
    store, data = api.app.state.store, api.app.state.settings.data
    id = api.post("/v1/jobs", json={"scan": scan}).json()["jobID"]
    made = data / "jobs" / id / "attempt-1" / "report.json"
    made.parent.mkdir(parents=True)
    made.write_text("{}")
    store.begin(id, 1)
    store.end(id, 1, "successful", [ArtifactRow("report.json", "attempt-1/report.json", 2, "0" * 64)])
    api.patch(f"/v1/jobs/{id}", json={"pinned": True})
    problem(api.delete(f"/v1/jobs/{id}"), 409, "pinned")
    assert api.get(f"/v1/jobs/{id}/artifacts/report.json").text == "{}"
    api.patch(f"/v1/jobs/{id}", json={"pinned": False})
    assert api.delete(f"/v1/jobs/{id}").json()["status"] == "dismissed"
    assert api.get(f"/v1/jobs/{id}/artifacts").json() == {"artifacts": []} and not made.exists()
    problem(api.get(f"/v1/jobs/{id}/artifacts/report.json"), 404, "no 'report.json'")
    problem(api.delete(f"/v1/jobs/{id}"), 410, "dismissed before")


def test_api__an_older_attempt_commits_nothing(api, scan):
    store = api.app.state.store
    id = api.post("/v1/jobs", json={"scan": scan}).json()["jobID"]
    assert store.begin(id, 1) and store.begin(id, 1)
    store.dismiss(id)
    assert not store.end(id, 1, "successful", []) and store.retry(id) and store.begin(id, 2)
    assert not store.end(id, 1, "failed", []) and store.job(id).status == RUNNING
    assert store.end(id, 2, "successful", []) and not store.end(id, 2, "successful", [])


def test_api__jobs_in_flight_are_limited_by_owner(tmp_path, ball):
    with TestClient(app_for(tmp_path, max_jobs_in_flight=2), base_url="http://127.0.0.1") as api:
        scan = api.post("/v1/scans", files={"file": ("ball.ply", ball)}).json()["id"]
        assert [api.post("/v1/jobs", json={"scan": scan}).status_code for _ in range(3)] == [201, 201, 429]


def test_api__what_has_expired_is_swept_unless_pinned(tmp_path, ball):
    with TestClient(app_for(tmp_path, retention_s=0.01), base_url="http://127.0.0.1") as api:
        settings, store = api.app.state.settings, api.app.state.store
        scan = api.post("/v1/scans", files={"file": ("ball.ply", ball)}).json()["id"]
        ids = [api.post("/v1/jobs", json={"scan": scan}).json()["jobID"] for _ in range(2)]
        assert api.patch(f"/v1/jobs/{ids[0]}", json={"pinned": True}).json()["pinned"]
        [api.delete(f"/v1/jobs/{id}") for id in ids]
        time.sleep(0.05)
        tidy(settings, store)
        assert [api.get(f"/v1/jobs/{id}").status_code for id in ids] == [200, 404]
        assert api.get(f"/v1/scans/{scan}").status_code == 200  # the pinned job needs it
        api.patch(f"/v1/jobs/{ids[0]}", json={"pinned": False})
        tidy(settings, store)
        tidy(settings, store)
        assert api.get(f"/v1/scans/{scan}").status_code == 404 and not files_of(api)


# --- who may


def test_api__beyond_loopback_a_token_is_needed_and_owners_see_their_own(tmp_path, ball):
    with TestClient(app_for(tmp_path, host="0.0.0.0"), base_url="http://scans.example") as api:
        assert (
            problem(api.get("/v1/jobs"), 401, "no token")["hint"]
            and api.get("/v1/jobs").headers["www-authenticate"] == "Bearer"
        )
        ann, bob = ({"Authorization": f"Bearer {api.app.state.store.add_token(name)}"} for name in ("ann", "bob"))
        problem(api.get("/v1/jobs", headers={"Authorization": "Bearer wrong"}), 401, "not known")
        scan = api.post("/v1/scans", files={"file": ("ball.ply", ball)}, headers=ann).json()["id"]
        job = api.post("/v1/jobs", json={"scan": scan}, headers=ann).json()["jobID"]
        for path in (f"/v1/jobs/{job}", f"/v1/scans/{scan}", f"/v1/jobs/{job}/events", f"/v1/jobs/{job}/artifacts"):
            assert api.get(path, headers=bob).status_code == 404 and api.get(path).status_code == 401
        assert api.delete(f"/v1/jobs/{job}", headers=bob).status_code == 404
        problem(api.post("/v1/jobs", json={"scan": scan}, headers=bob), 422, "no scan")
        assert api.get("/v1/jobs", headers=bob).json()["numberMatched"] == 0
        secrets = [api.get("/v1/webhook-secret", headers=who).json()["secret"] for who in (ann, bob)]
        assert secrets[0] != secrets[1] and all(s.startswith("whsec_") for s in secrets)


def test_api__on_loopback_no_other_page_may_ask(api):
    problem(api.get("/v1/jobs", headers={"Host": "evil.example"}), 403, "loopback")
    problem(api.post("/v1/jobs", json={}, headers={"Sec-Fetch-Site": "cross-site"}), 403, "own page")


# --- the rest


def test_api__options_and_presets_are_those_of_the_command_line(api):
    options = {o["name"]: o for o in api.get("/v1/options").json()}
    assert (
        options["dictionary_bits"]["domain"] == {"enum": ["auto", 8, 9, 10, 11, 12, 13, 14, 16]}
        and options["iterations"]["value"] == Settings().iterations
    )
    assert [p["name"] for p in api.get("/v1/presets").json()] == ["draft", "balanced", "high", "archive"]


def test_api__health_and_metrics(api, scan):
    assert api.get("/healthz").json() == {"status": "ok", "version": VERSION}
    ready = api.get("/readyz")
    assert ready.status_code == 503 and ready.json()["checks"] == {"database": True, "disk": True, "runner": False}
    text = api.get("/metrics").text
    assert re.search(r'splatpress_jobs\{status="accepted"\} \d', text) and "splatpress_scan_bytes" in text


def test_api__schemas_of_documents_are_published(api):
    for name in ("report.json", "evaluate.json"):
        schema = api.get(f"/v1/schemas/{name}").json()
        assert schema["$id"] == f"/v1/schemas/{name}" and schema["$ref"].removeprefix("#/$defs/") in schema["$defs"]
    assert api.get("/v1/schemas/other").status_code == 404


def test_api__the_page_needs_no_other_host(api):
    for path in ("/", "/docs", "/web/page.js", "/web/page.css", "/web/docs.js"):
        answer = api.get(path)
        assert answer.status_code == 200 and "default-src 'self'" in answer.headers["content-security-policy"]
        assert not re.search(r"https?://(?!www\.w3\.org/2000/svg)", answer.text)
    assert api.get("/web/../settings.py").status_code == 404


@schemathesis.serializer("application/offset+octet-stream")
def _as_bytes(context, value):
    return value if isinstance(value, bytes) else str(value).encode()


def test_api__schemathesis_finds_no_5xx_and_no_answer_that_the_schema_does_not_know(tmp_path, ball, monkeypatch):
    def nowhere(host: str, *_) -> str:
        raise RefusedAddress(f"{host} is not looked up in a test")

    monkeypatch.setattr(by_url, "public_address", nowhere)
    with TestClient(app_for(tmp_path), base_url="http://127.0.0.1") as api:
        scan = api.post("/v1/scans", files={"file": ("ball.ply", ball)}).json()["id"]
        job = api.post("/v1/jobs", json={"scan": scan}).json()["jobID"]
        api.delete(f"/v1/jobs/{job}")
        known = {"job": job, "scan": scan, "upload": begin(api, ball).rpartition("/")[2]}
        schema = schemathesis.openapi.from_asgi("/v1/openapi.json", api.app).exclude(path_regex="^/readyz$")
        operations = [result.ok() for result in schema.get_all_operations()]
        assert len(operations) > 35
        for operation in operations:
            _try(operation, next((id for kind, id in known.items() if f"/{kind}s/{{id}}" in operation.path), None))


CHECKS = [
    not_a_server_error,
    checks.status_code_conformance,
    checks.content_type_conformance,
    checks.response_schema_conformance,
    checks.response_headers_conformance,
    checks.allow_header_conformance,
]


def _try(operation, known: str | None) -> None:
    """With random ids, and with one that exists."""

    @given(case=operation.as_strategy())
    @settings(max_examples=6, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    def is_as_the_schema_says(case):
        for id in {None, known}:
            if id and not operation.path.endswith("/retry"):  # a job that waits has events without end
                case.path_parameters["id"] = id
            answer = case.call(base_url="http://127.0.0.1")
            assert answer.status_code < 500, (case.method, case.path, case.query, case.body, answer.text)
            case.validate_response(answer, checks=CHECKS)

    is_as_the_schema_says()
