"""Webhooks: signed by Standard Webhooks, tried again, and never into a private network."""

from __future__ import annotations

import threading
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest
from standardwebhooks import Webhook

from services import webhooks
from services.settings import settings_from
from services.store import Store
from services.webhooks import RefusedAddress, check_url, deliver_due, owner_secret


@pytest.fixture
def receiver():
    heard: list[tuple[dict, bytes]] = []
    answers = [500, 200]

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            heard.append((dict(self.headers), self.rfile.read(int(self.headers["content-length"]))))
            self.send_response(answers[min(len(heard), len(answers)) - 1])
            self.end_headers()

        def log_message(self, *_):
            pass

    server = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://localhost:{server.server_port}/hook", heard
    server.shutdown()
    server.server_close()


def ended_job(tmp_path, url: str, **changes):
    settings = settings_from({}, data=tmp_path, **changes)
    store = Store(settings.database_url)
    row = {"owner": "ann", "scan": "0" * 64, "name": "n", "settings": {}, "webhook": url, "request_key": None, "request_hash": None}
    job, _ = store.add_job(row, 10)
    store.begin(job["id"], 1)
    store.end(job["id"], 1, "successful", [])
    return settings, store, job["id"]


def test_webhooks__are_signed_and_tried_again_until_they_arrive(tmp_path, receiver, monkeypatch):
    monkeypatch.setattr(webhooks, "BACKOFF_S", (0, 0))
    url, heard = receiver
    settings, store, id = ended_job(tmp_path, url, webhook_private=True)
    for _ in range(3):
        deliver_due(settings, store, lambda job: {"jobID": job["id"], "status": job["status"]})
    assert len(heard) == 2 and heard[0][1] != b"" and heard[0][0]["webhook-id"] == heard[1][0]["webhook-id"]
    headers, body = heard[1]
    found = Webhook(owner_secret(settings, "ann")).verify(body, {k.lower(): v for k, v in headers.items()})
    assert found["type"] == "job.successful" and found["data"] == {"jobID": id, "status": "successful"}
    with pytest.raises(Exception):
        Webhook(owner_secret(settings, "bob")).verify(body, {k.lower(): v for k, v in headers.items()})
    store.close()


def test_webhooks__a_name_that_leads_to_a_private_address_is_refused_at_delivery(tmp_path, receiver, monkeypatch):
    url, heard = receiver
    settings, store, id = ended_job(tmp_path, url.replace("localhost", "hooks.example.org"))
    monkeypatch.setattr(webhooks.socket, "getaddrinfo", lambda host, port, **_: [(0, 0, 0, "", ("10.1.2.3", port))])
    deliver_due(settings, store, lambda job: {})
    assert not heard and not store.due_webhooks(5)
    assert "10.1.2.3 is a private address" in store.logs(id, 0, 9)[0]["data"]["message"]
    store.close()


@pytest.mark.parametrize("url", [
    "http://127.0.0.1/", "http://[::1]/", "http://10.0.0.1/", "http://192.168.1.1/", "http://172.16.0.1/", "http://169.254.169.254/",
    "http://[fe80::1]/", "http://[::ffff:127.0.0.1]/", "http://0.0.0.0/", "http://localhost/", "http://a.internal/", "http://router/",
    "file:///etc/passwd", "http://user@example.org/", "http://example.org:99999/", "http://224.0.0.1/",
])
def test_webhooks__private_addresses_are_refused_at_the_door(url):
    with pytest.raises(RefusedAddress):
        check_url(url, allow_private=False)
    check_url("https://hooks.example.org:8443/x", allow_private=False)
