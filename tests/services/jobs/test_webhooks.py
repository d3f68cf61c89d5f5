"""Webhooks: signed by Standard Webhooks, tried again, and never into a private network."""

from __future__ import annotations

import socket
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest
from standardwebhooks import Webhook

from services import addresses
from services.jobs import webhooks
from services.jobs.webhooks import AT_ONCE_OF_ONE_OWNER, RefusedAddress, check_url, deliver_due, owner_secret
from services.settings import settings_from
from services.store.rows import NewJob
from services.store.store import Store

# Hosts that the address parser, the IDNA codec or the name server's client answers with an exception of its own
POISON = (
    "http://0177.0.0.1/",
    "http://256.1.1.1/",
    "http://a..b.com/",
    f"http://{'a' * 64}.example.org/",
    "http://0x7f.1/",
    "http://2130706433/",
    f"http://{'abcdefghi.' * 26}org/",
    "http://xn--a.example.org/",
    "http://\u2024.example.org/",
)


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
    return settings, store, add_ended(store, url, "ann")


def add_ended(store: Store, url: str, owner: str) -> str:
    job, _ = store.add_job(NewJob(owner, "0" * 64, "n", {}, "compress", webhook=url), 100)
    store.begin(job.id, 1)
    store.end(job.id, 1, "successful", [])
    return job.id


def test_webhooks__are_signed_and_tried_again_until_they_arrive(tmp_path, receiver, monkeypatch):
    monkeypatch.setattr(webhooks, "BACKOFF_S", (0, 0))
    url, heard = receiver
    settings, store, id = ended_job(tmp_path, url, webhook_private=True)
    for _ in range(3):
        deliver_due(settings, store, lambda job: {"jobID": job.id, "status": job.status})
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
    monkeypatch.setattr(addresses.socket, "getaddrinfo", lambda host, port, **_: [(0, 0, 0, "", ("10.1.2.3", port))])
    deliver_due(settings, store, lambda job: {})
    assert not heard and not store.due_webhooks(5, 5)
    assert "10.1.2.3 is a private address" in store.logs(id, 0, 9)[0].data["message"]
    store.close()


@pytest.mark.parametrize(
    "url",
    [
        "http://127.0.0.1/",
        "http://[::1]/",
        "http://10.0.0.1/",
        "http://192.168.1.1/",
        "http://172.16.0.1/",
        "http://169.254.169.254/",
        "http://[fe80::1]/",
        "http://[::ffff:127.0.0.1]/",
        "http://0.0.0.0/",
        "http://localhost/",
        "http://a.internal/",
        "http://router/",
        "file:///etc/passwd",
        "http://user@example.org/",
        "http://example.org:99999/",
        "http://224.0.0.1/",
        "http://[64:ff9b::127.0.0.1]/",
        "http://[64:ff9b::a01:203]/",
        "http://[2002:7f00:1::]/",
        "http://[2002:a01:203::1]/",
        "http://[::127.0.0.1]/",
        "http://[::ffff:0:10.1.2.3]/",
        "http://[2001:0:0:0:0:0:f5ff:fffe]/",
        "http://[fec0::1]/",
    ],
)
def test_webhooks__private_addresses_are_refused_at_the_door(url):
    with pytest.raises(RefusedAddress):
        check_url(url, allow_private=False)
    for good in (
        "https://hooks.example.org:8443/x",
        "http://[2606:4700::1111]/",
        "http://[64:ff9b::808:808]/",
        "http://8.8.8.8/",
        "https://b\u00fccher.example/",
        "https://hooks.example.org./x",
    ):
        check_url(good, allow_private=False)


@pytest.mark.parametrize("url", POISON)
@pytest.mark.parametrize("allow_private", [False, True])
def test_webhooks__hosts_that_are_no_names_are_refused_at_the_door(url, allow_private):
    with pytest.raises(RefusedAddress):
        check_url(url, allow_private)


@pytest.mark.parametrize("url", POISON)
def test_webhooks__a_poison_entry_of_before_is_given_up_and_stops_nobody_elses(tmp_path, receiver, url):
    """As a service that is started on the rows of one that let it in."""
    good, heard = receiver
    settings, store, id = ended_job(tmp_path, url, webhook_private=True)
    other = add_ended(store, good, "bob")
    deliver_due(settings, store, lambda job: {})
    assert len(heard) == 1 and other in heard[0][0]["webhook-id"]
    assert [job.id for job in store.due_webhooks(5, 5)] == []
    assert "given up" in store.logs(id, 0, 9)[0].data["message"] or "refused" in store.logs(id, 0, 9)[0].data["message"]
    store.close()


def test_webhooks__any_error_of_ours_gives_up_that_entry_alone_and_is_logged(tmp_path, receiver):
    good, heard = receiver
    settings, store, id = ended_job(tmp_path, good, webhook_private=True)
    add_ended(store, good, "bob")

    def describe(job: dict) -> dict:
        if job.id == id:
            raise KeyError("of ours")
        return {}

    deliver_due(settings, store, describe)
    assert len(heard) == 1 and not [job for job in store.due_webhooks(5, 5) if job.id == id]
    found = store.logs(id, 0, 9)[0]
    assert found.level == "error" and "given up (KeyError" in found.data["message"]
    store.close()


def test_webhooks__one_owners_many_slow_hosts_leave_another_a_place_in_the_first_round(tmp_path, receiver):
    good, heard = receiver
    with socket.create_server(("127.0.0.1", 0), backlog=64) as silent:
        settings, store, _ = ended_job(tmp_path, f"http://127.0.0.1:{silent.getsockname()[1]}/", webhook_private=True)
        for _ in range(30):
            add_ended(store, f"http://127.0.0.1:{silent.getsockname()[1]}/", "ann")
        add_ended(store, good, "bob")
        deliver_due(settings, store, lambda job: {}, timeout_s=2.0)
        assert len(heard) == 1 and sum(job.webhook_tries for job in store.jobs("ann", 99, 0)[0]) == AT_ONCE_OF_ONE_OWNER
    store.close()


def test_runner__what_fails_in_deliveries_does_not_stop_tidying(tmp_path, monkeypatch):
    from services.jobs import runner

    tidied, stop = [], threading.Event()
    monkeypatch.setattr(runner, "deliver_due", lambda *_: 1 / 0)
    monkeypatch.setattr(runner, "tidy", lambda *_: (tidied.append(1), stop.set()))
    beside = threading.Thread(target=runner._beside, args=(settings_from({}, data=tmp_path), None, stop), daemon=True)
    beside.start()
    beside.join(300)
    stop.set()
    assert tidied
