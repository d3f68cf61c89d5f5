"""Uploads that are cut, stalled, overtaken, promised beyond the disk, or sent by those who may not."""

from __future__ import annotations

import base64
import hashlib
import socket
import threading
import time
from collections import namedtuple
from pathlib import Path

import httpx
import pytest
import yaml
from fastapi.testclient import TestClient

from services.api.app import create_app
from services.cli import uploading
from services.cli.answers import ServiceError
from services.cli.client import Client, zip_folder
from services.cli.uploading import Memory
from services.settings import settings_from
from services.uploads import room
from tests.services.scans import photo_scan, point_scan
from tests.services.service_process import ROOT, api_alone

TUS = {"Tus-Resumable": "1.0.0"}
PATCH = {**TUS, "Content-Type": "application/offset+octet-stream"}


def metadata(name: str) -> dict[str, str]:
    return {"Upload-Metadata": "filename " + base64.b64encode(name.encode()).decode()}


@pytest.fixture(scope="module")
def ball(tmp_path_factory) -> bytes:
    return point_scan(tmp_path_factory.mktemp("ball") / "ball.ply", 5000).read_bytes()


@pytest.fixture
def api(tmp_path):
    (tmp_path / "data").mkdir()
    app = create_app(settings_from({}, data=tmp_path / "data", reserve_bytes=0))
    with TestClient(app, base_url="http://127.0.0.1", raise_server_exceptions=False) as client:
        yield client


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    folder = tmp_path_factory.mktemp("api")
    with api_alone(folder / "data", body_idle_s="2", headers_s="1", reserve_bytes="0") as started:
        yield started


def begun(url: str, content: bytes, name: str = "ball.ply") -> str:
    headers = {**TUS, "Upload-Length": str(len(content)), **metadata(name)}
    return url + httpx.post(url + "/v1/uploads", headers=headers).headers["location"]


def stalled_patch(where: str, content: bytes, n_sent: int) -> socket.socket:
    """A connection that has promised all of `content` and sent a part."""
    url = httpx.URL(where)
    connection = socket.create_connection((url.host, url.port))
    lines = [
        f"PATCH {url.path} HTTP/1.1",
        f"Host: {url.host}:{url.port}",
        "Upload-Offset: 0",
        f"Content-Length: {len(content)}",
    ]
    lines += [f"{name}: {value}" for name, value in PATCH.items()]
    connection.sendall("\r\n".join(lines).encode() + b"\r\n\r\n" + content[:n_sent])
    return connection


def offset(where: str) -> int:
    return int(httpx.head(where, headers=TUS).headers["upload-offset"])


def wait_for_offset(where: str, wanted: int) -> None:
    deadline = time.monotonic() + 300
    while offset(where) != wanted:
        assert time.monotonic() < deadline, offset(where)
        time.sleep(0.02)


# --- cut, stalled, overtaken


def test_uploads__a_newer_patch_takes_over_from_one_that_hangs(server, ball):
    where = begun(server.url, ball)
    with stalled_patch(where, ball, 1000) as hanging:
        wait_for_offset(where, 1000)
        done = httpx.patch(where, content=ball[1000:], headers={**PATCH, "Upload-Offset": "1000"}, timeout=300)
        assert done.status_code == 204 and done.headers["splatpress-scan"] == hashlib.sha256(ball).hexdigest()
        assert b" 423 " in hanging.recv(1000)


def test_uploads__a_body_that_stands_still_is_ended_and_what_arrived_stays(server, ball):
    where = begun(server.url, ball + b"x")
    with stalled_patch(where, ball + b"x", 1000) as hanging:
        hanging.settimeout(300)
        assert b" 408 " in hanging.recv(1000)
    assert offset(where) == 1000


def test_uploads__two_that_write_at_once_mix_no_bytes(server, ball):
    content = ball * 40
    where = begun(server.url, content)
    answers: list[int] = []

    def send() -> None:
        for _ in range(60):
            at = offset(where)
            if at == len(content):
                return
            piece = content[at : at + 300_000]
            answers.append(
                httpx.patch(where, content=piece, headers={**PATCH, "Upload-Offset": str(at)}, timeout=300).status_code
            )

    threads = [threading.Thread(target=send) for _ in range(3)]
    [t.start() for t in threads]
    [t.join(300) for t in threads]
    assert set(answers) <= {204, 409, 423, 404, 422} and 204 in answers
    # forty balls one behind the other are one scan of 5,000 points and some bytes too many: refused, or taken as it is


def test_uploads__lengths_may_be_said_later(api, ball):
    made = api.post("/v1/uploads", headers={**TUS, "Upload-Defer-Length": "1", **metadata("ball.ply")})
    assert (
        made.status_code == 201 and made.headers["upload-defer-length"] == "1" and "upload-length" not in made.headers
    )
    where = made.headers["location"]
    assert api.patch(where, content=ball[:500], headers={**PATCH, "Upload-Offset": "0"}).status_code == 204
    assert api.head(where, headers=TUS).headers["upload-defer-length"] == "1"
    headers = {**PATCH, "Upload-Offset": "500", "Upload-Length": str(len(ball))}
    done = api.patch(where, content=ball[500:], headers=headers)
    assert done.status_code == 204 and done.headers["splatpress-scan"] == hashlib.sha256(ball).hexdigest()
    both = {**TUS, "Upload-Defer-Length": "1", "Upload-Length": "5", **metadata("a.ply")}
    assert api.post("/v1/uploads", headers=both).status_code == 400


def test_uploads__a_creation_may_bring_the_first_bytes(api, ball):
    headers = {**PATCH, "Upload-Length": str(len(ball)), **metadata("ball.ply")}
    part = api.post("/v1/uploads", content=ball[:700], headers=headers)
    assert part.status_code == 201 and part.headers["upload-offset"] == "700"
    whole = api.post("/v1/uploads", content=ball, headers=headers)
    assert whole.status_code == 201 and whole.headers["splatpress-scan"] == hashlib.sha256(ball).hexdigest()
    bad = {**PATCH, "Upload-Length": "9", **metadata("a.zip")}
    assert api.post("/v1/uploads", content=b"\x89PNGxxxxx", headers=bad).status_code == 422


def test_uploads__parts_are_joined_in_the_order_that_is_said(api, ball):
    cuts = [ball[:40_000], ball[40_000:70_001], ball[70_001:]]
    parts = []
    for cut in (cuts[2], cuts[0], cuts[1]):
        headers = {**PATCH, "Upload-Length": str(len(cut)), "Upload-Concat": "partial"}
        made = api.post("/v1/uploads", content=cut, headers=headers)
        assert made.status_code == 201 and made.headers["upload-concat"] == "partial", made.text
        parts.append(made.headers["location"])
    order = f"final;{parts[1]} http://any.example{parts[2]} {parts[0]}"
    done = api.post("/v1/uploads", headers={**TUS, "Upload-Concat": order, **metadata("ball.ply")})
    assert done.status_code == 201 and done.headers["splatpress-scan"] == hashlib.sha256(ball).hexdigest()
    assert api.head(done.headers["location"], headers=TUS).headers["upload-concat"] == order
    assert [api.head(part, headers=TUS).status_code for part in parts] == [404] * 3
    uploads = api.app.state.settings.data / "uploads"
    assert list(uploads.iterdir()) == []


def test_uploads__parts_that_are_not_whole_or_nobodys_are_not_joined(api, ball):
    made = api.post("/v1/uploads", headers={**TUS, "Upload-Length": "99", "Upload-Concat": "partial"})
    for order in (f"final;{made.headers['location']}", f"final;/v1/uploads/{'0' * 32}", "final;", "finally"):
        answer = api.post("/v1/uploads", headers={**TUS, "Upload-Concat": order, **metadata("ball.ply")})
        assert answer.status_code == 400, order


def test_uploads__a_post_may_stand_for_a_patch_or_a_delete(api, ball):
    made = api.post("/v1/uploads", headers={**TUS, "Upload-Length": str(len(ball)), **metadata("ball.ply")})
    where = made.headers["location"]
    headers = {**PATCH, "Upload-Offset": "0", "X-HTTP-Method-Override": "PATCH"}
    assert api.post(where, content=ball[:9], headers=headers).headers["upload-offset"] == "9"
    assert api.post(where, headers={**TUS, "X-HTTP-Method-Override": "DELETE"}).status_code == 204
    assert api.head(where, headers=TUS).status_code == 404


def test_uploads__what_is_advertised_is_what_works(api):
    found = api.options("/v1/uploads").headers["tus-extension"].split(",")
    assert set(found) == {
        "creation", "creation-with-upload", "creation-defer-length", "concatenation", "expiration", "checksum", "termination",
    }  # fmt: skip


# --- the command line's client goes on


class Died(BaseException):
    """As a kill: no handler of the client's runs."""


def sent_bytes(client: Client) -> list[int]:
    """How many bytes of body each PATCH of a client carries, from here on."""
    sizes: list[int] = []
    client._http.event_hooks["request"].append(
        lambda request: sizes.append(len(request.content)) if request.method == "PATCH" else None
    )
    return sizes


def test_client__a_file_goes_on_where_a_process_that_died_left_it(server, ball, tmp_path, monkeypatch):
    monkeypatch.setattr(uploading, "PIECE_BYTES", 20_000)
    path, memory = tmp_path / "ball.ply", Memory(tmp_path / "state" / "uploads.json")
    path.write_bytes(ball)

    def die(sent: int, total: int) -> None:
        if sent >= 60_000:
            raise Died

    with Client(server.url, memory=memory) as first, pytest.raises(Died):
        first.upload(path, die)
    with Client(server.url, memory=Memory(memory.path)) as second:
        sizes = sent_bytes(second)
        assert second.upload(path)["id"] == hashlib.sha256(ball).hexdigest()
    assert sum(sizes) == len(ball) - 60_000
    assert memory._read() == {}


def test_client__another_file_of_that_name_begins_anew(server, ball, tmp_path, monkeypatch):
    monkeypatch.setattr(uploading, "PIECE_BYTES", 20_000)
    path, memory = tmp_path / "ball.ply", Memory(tmp_path / "uploads.json")
    path.write_bytes(ball)

    def die(sent: int, total: int) -> None:
        if sent >= 40_000:
            raise Died

    with Client(server.url, memory=memory) as client, pytest.raises(Died):
        client.upload(path, die)
    changed = bytearray(ball)
    changed[-1] ^= 1  # the same name, size and first bytes, but another time
    path.write_bytes(changed)
    with Client(server.url, memory=memory) as client:
        assert client.upload(path)["id"] == hashlib.sha256(changed).hexdigest()


def test_client__a_folder_goes_on_too(server, tmp_path, monkeypatch):
    monkeypatch.setattr(uploading, "PIECE_BYTES", 20_000)
    folder, memory = photo_scan(tmp_path / "plane", n_side=12), Memory(tmp_path / "uploads.json")

    def die(sent: int, total: int) -> None:
        if sent >= 40_000:
            raise Died

    with Client(server.url, memory=memory) as first, pytest.raises(Died):
        first.upload(folder, die)
    zip_folder(folder, tmp_path / "whole.zip")
    with Client(server.url, memory=memory) as second:
        sizes = sent_bytes(second)
        assert second.upload(folder)["points"] == 144
    assert sum(sizes) == (tmp_path / "whole.zip").stat().st_size - 40_000


def test_client__an_upload_outlives_an_api_that_is_killed_and_started_anew(ball, tmp_path, monkeypatch):
    monkeypatch.setattr(uploading, "PIECE_BYTES", 20_000)
    (tmp_path / "ball.ply").write_bytes(ball)
    killed = []
    with (
        api_alone(tmp_path / "data", reserve_bytes="0") as server,
        Client(server.url, memory=Memory(tmp_path / "m")) as client,
    ):
        sizes = sent_bytes(client)

        def kill(sent: int, total: int) -> None:
            if sent >= 60_000 and not killed:
                killed.append(sent)
                server.kill()
                threading.Timer(1.5, server.start).start()

        assert client.upload(tmp_path / "ball.ply", kill)["points"] == 5000
    assert killed and sum(sizes) <= len(ball) + 20_000  # at most the piece that was under way went twice


def test_client__a_refused_scan_is_not_tried_again(server, tmp_path):
    path, memory = tmp_path / "a.zip", Memory(tmp_path / "m")
    path.write_bytes(b"\x89PNG" + bytes(99))
    with Client(server.url, memory=memory) as client, pytest.raises(ServiceError) as raised:
        client.upload(path)
    assert raised.value.status == 422 and raised.value.kind == "data" and memory._read() == {}


# --- promised beyond the disk, sent by those who may not


def test_uploads__no_more_is_promised_than_the_disk_holds(tmp_path, monkeypatch):
    """300 of 20 GB, with 55 GB free."""
    (tmp_path / "data").mkdir()
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(room.shutil, "disk_usage", lambda path: usage(10**12, 0, 55 * 10**9))
    app = create_app(settings_from({}, data=tmp_path / "data", max_uploads_at_once=1000, reserve_bytes=10**9))
    with TestClient(app, base_url="http://127.0.0.1") as api:
        headers = {**TUS, "Upload-Length": str(20 * 10**9), **metadata("a.zip")}
        statuses = [api.post("/v1/uploads", headers=headers).status_code for _ in range(300)]
        assert statuses.count(201) == 2 and statuses.count(507) == 298
        found = api.get("/v1/uploads").json()["uploads"]
        assert len(found) == 2
        assert api.delete(f"/v1/uploads/{found[0]['id']}", headers=TUS).status_code == 204
        assert api.post("/v1/uploads", headers=headers).status_code == 201


def test_uploads__an_owner_has_so_many_at_once_and_so_many_bytes(tmp_path, ball):
    (tmp_path / "data").mkdir()
    settings = settings_from(
        {}, data=tmp_path / "data", max_uploads_at_once=3, max_owner_bytes=2 * len(ball), reserve_bytes=0
    )
    with TestClient(create_app(settings), base_url="http://127.0.0.1") as api:
        small = {**TUS, "Upload-Length": "10", **metadata("a.ply")}
        assert [api.post("/v1/uploads", headers=small).status_code for _ in range(4)] == [201, 201, 201, 429]
        for upload in api.get("/v1/uploads").json()["uploads"]:
            api.delete(f"/v1/uploads/{upload['id']}", headers=TUS)
        large = {**PATCH, "Upload-Length": str(len(ball)), **metadata("a.ply")}
        scan = api.post("/v1/uploads", content=ball, headers=large).headers["splatpress-scan"]
        assert api.post("/v1/uploads", headers=large).status_code == 201  # half of it taken, half of it promised
        refused = api.post("/v1/uploads", headers=small)
        assert refused.status_code == 413 and "of one owner" in refused.json()["detail"]
        assert (
            api.delete(f"/v1/scans/{scan}").status_code == 204
            and api.post("/v1/uploads", headers=small).status_code == 201
        )


def test_uploads__a_disk_that_fills_up_ends_the_request_as_the_services_matter(api, ball, monkeypatch):
    from services.uploads import writer

    made = api.post("/v1/uploads", headers={**TUS, "Upload-Length": str(len(ball)), **metadata("ball.ply")})
    monkeypatch.setattr(writer, "LOOK_FOR_ROOM_BYTES", 1000)
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(writer.shutil, "disk_usage", lambda path: usage(10**12, 0, -1))
    answer = api.patch(made.headers["location"], content=ball, headers={**PATCH, "Upload-Offset": "0"})
    assert answer.status_code == 507 and answer.json()["class"] == "resource" and answer.json()["retryable"]


@pytest.fixture(scope="module")
def guarded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("guarded")
    with api_alone(folder / "data", host="0.0.0.0", headers_s="3", body_idle_s="2", reserve_bytes="0") as started:
        yield started


@pytest.mark.parametrize(
    ("request_line", "headers"),
    [
        ("POST /v1/scans", "Content-Type: multipart/form-data; boundary=b"),
        ("POST /v1/jobs", "Content-Type: application/json"),
        ("POST /v1/uploads", "Content-Type: application/offset+octet-stream\r\nTus-Resumable: 1.0.0"),
        ("PATCH /v1/uploads/" + "0" * 32, "Content-Type: application/offset+octet-stream\r\nTus-Resumable: 1.0.0"),
    ],
)
def test_api__a_stranger_hears_401_before_a_byte_of_his_body_is_read(guarded, request_line, headers):
    with socket.create_connection(("127.0.0.1", guarded.port)) as connection:
        connection.settimeout(300)
        head = f"{request_line} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 900000\r\n{headers}\r\n\r\n"
        connection.sendall(head.encode())  # and not one byte of the body
        answer = connection.recv(4000)
        assert b" 401 " in answer and b"www-authenticate: Bearer" in answer.lower().replace(b"bearer", b"Bearer")
    assert not [p for p in Path(guarded.data / "incoming").rglob("*") if p.is_file()]


def test_api__headers_that_never_end_are_dropped(guarded):
    connections = []
    for sent in (
        b"",
        b"GET /healthz HTTP/1.1\r\nHost: 127",
        b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\nGET /he",
    ):
        connections.append(socket.create_connection(("127.0.0.1", guarded.port), timeout=300))
        connections[-1].sendall(sent)
    for connection in connections:
        with connection:
            while connection.recv(4000):  # raises TimeoutError where it stays open
                pass


def test_api__a_slow_but_steady_request_is_served(guarded):
    with socket.create_connection(("127.0.0.1", guarded.port)) as connection:
        for _ in range(3):  # longer in all than headers may take, but each request's within it
            connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            answer = b""
            while b'"status":"ok"' not in answer:  # headers and body may come one by one
                answer += (part := connection.recv(4000))
                assert part, "closed"
            time.sleep(1.1)  # far below what headers may take, as a busy machine makes more of it


def test_compose__what_lies_in_memory_has_a_size():
    compose = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
    folders = [folder for service in compose["services"].values() for folder in service.get("tmpfs", [])]
    assert folders and all("size=" in folder for folder in folders)
