"""Dask's pages through the API: for who has a token, read-only, and nothing beyond the scheduler."""

from __future__ import annotations

import pytest
from distributed import LocalCluster
from fastapi.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from services.api.app import create_app
from services.settings import settings_from
from services.store.tokens import ID_LENGTH, token_hash


@pytest.fixture(scope="module")
def scheduler():
    with LocalCluster(n_workers=0, processes=False, dashboard_address="127.0.0.1:0", silence_logs="ERROR") as cluster:
        yield "http://127.0.0.1:" + cluster.dashboard_link.rpartition(":")[2]


@pytest.fixture
def api(tmp_path, scheduler):
    settings = settings_from({}, data=tmp_path, require_tokens=True, dashboard_url=scheduler)
    app = create_app(settings)
    with TestClient(app, base_url="http://127.0.0.1") as client:
        client.token = app.state.store.add_token("ann")
        yield client


def signed_in(api) -> None:
    answer = api.post("/v1/dashboard", headers={"Authorization": f"Bearer {api.token}"})
    told = answer.headers["set-cookie"]
    assert answer.status_code == 204 and all(
        word in told for word in ("HttpOnly", "SameSite=strict", "Path=/dashboard")
    )


def test_dashboard__is_for_those_with_a_token_that_is_still_good(api):
    assert api.get("/dashboard/status").status_code == 401 == api.post("/v1/dashboard").status_code
    signed_in(api)
    page = api.get("/dashboard/status")
    assert page.status_code == 200 and "bokeh" in page.text and page.headers["x-frame-options"] == "SAMEORIGIN"
    assert (
        "connect-src" not in page.headers["content-security-policy"]
        and api.get("/dashboard").url.path == "/dashboard/status"
    )
    assert api.get("/v1/jobs").status_code == 401  # the cookie opens nothing else
    revoked = token_hash(api.token)[:ID_LENGTH]
    assert api.delete(f"/v1/tokens/{revoked}", headers={"Authorization": f"Bearer {api.token}"}).status_code == 204
    assert api.get("/dashboard/status").status_code == 401


def test_dashboard__signing_out_takes_the_cookie(api):
    signed_in(api)
    assert api.delete("/v1/dashboard", headers={"Authorization": f"Bearer {api.token}"}).status_code == 204
    assert api.get("/dashboard/status").status_code == 401


@pytest.mark.parametrize("path", ["proxy/8787/127.0.0.1/status", "api/v1/retire_workers", "statics/../api/v1"])
def test_dashboard__what_leads_elsewhere_or_changes_something_is_not_passed_on(api, path):
    signed_in(api)
    assert api.get(f"/dashboard/{path}").status_code == 404
    assert api.post(f"/dashboard/{path}").status_code == 405


@pytest.mark.parametrize("origin", [None, "http://elsewhere.example", "http://127.0.0.1:81"])
def test_dashboard__no_page_of_another_site_and_nobody_unknown_hears_its_messages(api, origin):
    headers = {"origin": origin} if origin else {}
    with pytest.raises(WebSocketDisconnect), api.websocket_connect("/dashboard/status/ws", headers=headers):
        pass
    signed_in(api)
    with pytest.raises(WebSocketDisconnect) as refused, api.websocket_connect("/dashboard/status/ws", headers=headers):
        pass
    assert refused.value.code == 1008


def test_dashboard__without_a_scheduler_says_so(tmp_path):
    for url in ("", "http://127.0.0.1:9", "file:///etc/passwd"):
        app = create_app(settings_from({}, data=tmp_path, dashboard_url=url))
        with TestClient(app, base_url="http://127.0.0.1") as client:
            assert client.get("/dashboard/status").json()["title"] == "no dashboard"
