"""Scans by their address: fetched where an upload would do as well, refused where the address leads where it must
not."""

from __future__ import annotations

import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from fastapi.testclient import TestClient

from services.api.app import create_app
from services.settings import settings_from
from services.uploads.scans import file_hash
from storage.place import objects
from tests.services.bucket import BUCKET, bucket_environment, s3_server
from tests.services.scans import point_scan


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    return point_scan(tmp_path_factory.mktemp("scan") / "ball.ply", 300)


@pytest.fixture(scope="module")
def web(scan):
    """Other people's server; yields its address."""
    content = scan.read_bytes()

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_) -> None:
            pass

        def do_GET(self) -> None:
            if self.path == "/moved.ply":
                self.send_response(302)
                self.send_header("Location", "/ball.ply")
                return self.end_headers()
            if self.path == "/gone.ply":
                return self.send_error(404)
            body = b"a text, no scan" if self.path == "/text.ply" else content
            self.send_response(200)
            if self.path != "/unmeasured.ply":
                self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body[: len(body) // 2] if self.path == "/cut.ply" else body)

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


def api_of(data, **settings):
    data.mkdir(exist_ok=True)
    (data / "incoming").mkdir(exist_ok=True)
    return TestClient(create_app(settings_from({}, data=data, **settings)), base_url="http://127.0.0.1")


@pytest.fixture
def api(tmp_path):
    with api_of(tmp_path / "data", webhook_private=True, max_upload_bytes=100_000) as client:
        yield client
        uploads = tmp_path / "data" / "uploads"
        assert client.get("/v1/uploads").json() == {"uploads": []} and not (
            uploads.exists() and list(uploads.iterdir())
        )


def test_by_url__a_scan_is_that_of_an_upload(api, web, scan):
    first = api.post("/v1/scans/by-url", json={"url": web + "/ball.ply?key=1", "name": "mine.ply"})
    assert first.status_code == 201 and first.json()["id"] == file_hash(scan)
    assert first.json()["file"] == "mine.ply" and first.json()["points"] == 300
    assert api.get(first.headers["Location"]).json()["id"] == first.json()["id"]
    assert api.post("/v1/scans/by-url", json={"url": web + "/unmeasured.ply"}).status_code == 200
    with open(scan, "rb") as file:
        assert api.post("/v1/scans", files={"file": ("ball.ply", file)}).status_code == 200


@pytest.mark.parametrize(
    ("path", "status", "slug"),
    [
        ("/moved.ply", 422, "not-fetched"),
        ("/gone.ply", 422, "not-fetched"),
        ("/cut.ply", 422, "not-fetched"),
        ("/text.ply", 422, "bad-scan"),
        ("/ball.exe", 415, "unsupported-scan"),
    ],
)
def test_by_url__what_is_no_scan_or_not_whole_leaves_nothing(api, web, path, status, slug):
    answer = api.post("/v1/scans/by-url", json={"url": web + path})
    assert (answer.status_code, answer.json()["title"]) == (status, slug.replace("-", " ")), answer.json()
    assert api.get("/v1/scans").json()["scans"] == []


@pytest.mark.parametrize("path", ["/ball.ply", "/unmeasured.ply"])
def test_by_url__more_bytes_than_are_allowed_are_refused_told_or_not(tmp_path, web, path):
    with api_of(tmp_path / "data", webhook_private=True, max_upload_bytes=1000) as client:
        assert client.post("/v1/scans/by-url", json={"url": web + path}).status_code == 413


@pytest.mark.parametrize(
    "url",
    [
        "https://127.0.0.1/ball.ply",
        "https://[64:ff9b::7f00:1]/ball.ply",
        "https://0177.0.0.1/ball.ply",
        "https://localhost/ball.ply",
        "http://example.org/ball.ply",
        "https://user:word@example.org/ball.ply",
        "s3://scans/ball.ply",
    ],
)
def test_by_url__private_addresses_plain_http_and_buckets_are_refused_unless_allowed(tmp_path, url):
    with api_of(tmp_path / "data") as client:
        answer = client.post("/v1/scans/by-url", json={"url": url})
        assert answer.status_code == 422 and answer.json()["title"] == "refused url", answer.json()


def test_by_url__from_a_bucket_that_is_allowed_and_from_no_other(tmp_path, scan, monkeypatch):
    with s3_server() as port, api_of(tmp_path / "data", fetch_from=f"s3://{BUCKET}/in, s3://other") as client:
        for name, value in bucket_environment(port).items():
            monkeypatch.setenv(name, value)
        objects._bucket.cache_clear()
        objects.put(objects.Path(f"s3://{BUCKET}/in/a/ball.ply"), scan)
        objects.put(objects.Path(f"s3://{BUCKET}/secret/ball.ply"), scan)

        def fetched(url: str) -> int:
            return client.post("/v1/scans/by-url", json={"url": url}).status_code

        assert fetched(f"s3://{BUCKET}/in/a/ball.ply") == 201
        assert fetched(f"s3://{BUCKET}/secret/ball.ply") == fetched(f"s3://{BUCKET}/in/../secret/ball.ply") == 422
        assert fetched(f"s3://{BUCKET}/in/none.ply") == 422
        objects._bucket.cache_clear()
