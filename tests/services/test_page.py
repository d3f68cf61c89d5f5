"""The job page as people use it: uploads that go on, keys and history, what is refused, axe's rules in both colours."""

from __future__ import annotations

import importlib.util
import json
import os
import threading
import time
from pathlib import Path

import httpx
import pytest

from tests.services.chromium import Page, chromium_path
from tests.services.scans import padded_scan, point_scan
from tests.services.service_process import ApiProcess, service, until

pytestmark = pytest.mark.skipif(chromium_path() is None, reason="needs Chromium (apt-get install chromium)")
PIECE = 8 << 20
TUS = {"Tus-Resumable": "1.0.0"}


@pytest.fixture(scope="module")
def large(tmp_path_factory) -> Path:
    """A scan of 40 MB."""
    return padded_scan(tmp_path_factory.mktemp("large"), 40)


@pytest.fixture
def api(tmp_path):
    started = ApiProcess(tmp_path / "data", reserve_bytes="0")
    yield started
    started.kill()


@pytest.fixture
def page(tmp_path):
    opened = Page(tmp_path / "profile")
    yield opened
    opened.close()


def text(page: Page, id: str) -> str:
    return page.look(f"document.getElementById('{id}').innerText")


def slow(page: Page, bytes_per_second: int) -> None:
    page.call(
        "Network.emulateNetworkConditions",
        offline=False,
        latency=0,
        downloadThroughput=-1,
        uploadThroughput=bytes_per_second,
    )


def on_disk(api: ApiProcess) -> int:
    return sum(p.stat().st_size for p in (api.data / "uploads").rglob("*.zip"))


def at_rest(api: ApiProcess) -> int:
    """What is on disk once that stays for a second: what was on its way has come in."""
    before, now = -1, on_disk(api)
    while now != before:
        time.sleep(1)
        before, now = now, on_disk(api)
    return now


def uploaded(page: Page, seconds: float = 300) -> None:
    page.until("/144 points/.test(document.getElementById('upload-state').textContent)", seconds)


def is_without_serious_findings(page: Page) -> None:
    packed = Path(importlib.util.find_spec("axe_core_python").origin).with_name("axe.min.js")
    page.look(Path(os.environ.get("SPLATPRESS_AXE") or packed).read_text() + "; 1")  # a newer one may be named
    for scheme in ("light", "dark"):
        page.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        found = json.loads(
            page.look("axe.run(document, {resultTypes: ['violations']}).then((r) => JSON.stringify(r.violations))")
        )
        told = [(v["id"], v["impact"], [n["html"] for n in v["nodes"]][:3]) for v in found]
        assert not [v for v in told if v[1] in ("serious", "critical")], (scheme, told)
    page.call("Emulation.setEmulatedMedia", features=[])


def test_page__an_upload_goes_on_though_the_api_is_killed_and_started_anew(api, page, large):
    page.open(api.url + "/")
    page.until("document.querySelectorAll('#options input').length")
    slow(page, 8 << 20)
    page.choose_file("#file", large)
    until(lambda: on_disk(api) > PIECE)
    api.kill()
    there = on_disk(api)
    page.until("/trying again/.test(document.getElementById('upload-state').textContent)")
    threading.Timer(1.0, api.start).start()
    until(lambda: on_disk(api) > there)
    slow(page, -1)
    uploaded(page)
    assert text(page, "problem") == ""


def test_page__an_upload_goes_on_after_the_page_is_loaded_anew(api, page, large):
    page.open(api.url + "/")
    page.until("document.querySelectorAll('#options input').length")
    slow(page, 8 << 20)
    page.choose_file("#file", large)
    until(lambda: on_disk(api) > PIECE)
    page.open("about:blank")
    page.open(api.url + "/")
    page.until(
        "/large.zip: .* of .* are here; choose the file again to go on/.test(document.getElementById('unfinished').innerText)"
    )
    there = on_disk(api)
    sent = len(page.requests)
    slow(page, -1)
    page.choose_file("#file", large)
    uploaded(page)
    offsets = [int(r["headers"]["Upload-Offset"]) for r in page.requests[sent:] if r["method"] == "PATCH"]
    assert offsets[0] >= there > PIECE and not [r for r in page.requests[sent:] if r["method"] == "POST"]
    assert text(page, "unfinished") == ""


def test_page__an_upload_is_paused_and_goes_on_and_another_is_cancelled(api, page, large):
    page.open(api.url + "/")
    page.until("document.querySelectorAll('#options input').length")
    slow(page, 8 << 20)
    page.choose_file("#file", large)
    until(lambda: on_disk(api) > PIECE)
    page.look("document.getElementById('upload-pause').click()")
    page.until("/paused/.test(document.getElementById('upload-state').textContent)")
    there = at_rest(api)
    assert PIECE < there < large.stat().st_size
    page.look("document.getElementById('upload-resume').click()")
    until(lambda: on_disk(api) > there)
    page.look("document.getElementById('upload-cancel').click()")
    page.until("/cancelled/.test(document.getElementById('upload-state').textContent)")
    until(lambda: on_disk(api) == 0)
    slow(page, -1)
    page.choose_file("#file", large)
    uploaded(page)


def test_page__what_is_refused_stays_told_beside_the_file(api, page, tmp_path):
    (tmp_path / "bad.zip").write_bytes(b"\x89PNG" + bytes(200))
    (tmp_path / "bad.obj").write_bytes(b"v 0 0 0")
    page.open(api.url + "/")
    page.until("document.querySelectorAll('#options input').length")
    for name, words in (("bad.zip", "begins with"), ("bad.obj", "allowed")):
        page.choose_file("#file", tmp_path / name)
        page.until(f"/{name} was refused: .*{words}/.test(document.getElementById('upload-state').textContent)")
        time.sleep(0.3)
        assert "was refused" in text(page, "upload-state")
    assert page.look("document.getElementById('sent').hidden && document.getElementById('upload-cancel').hidden")


def test_page__jobs_by_keyboard_back_and_forward_search_and_unknown_ones(api, page, tmp_path):
    with httpx.Client(base_url=api.url, timeout=300) as http:
        ball = point_scan(tmp_path / "ball.ply", 50).read_bytes()
        scan = http.post("/v1/scans", files={"file": ("ball.ply", ball)}).json()["id"]
        jobs = [http.post("/v1/jobs", json={"scan": scan, "name": f"job {i:02d}"}).json()["jobID"] for i in range(30)]
    page.open(api.url + "/")
    page.until("document.querySelectorAll('#jobs a').length === 25")
    is_without_serious_findings(page)
    page.look("document.querySelector('#jobs a').focus()")
    for kind in ("keyDown", "keyUp"):
        page.call("Input.dispatchKeyEvent", type=kind, key="Enter", code="Enter", windowsVirtualKeyCode=13, text="\r")
    page.until("document.getElementById('job-name').textContent === 'job 29'")
    page.look(f"location.hash = '{jobs[3]}'")
    page.until("document.getElementById('job-name').textContent === 'job 03'")
    page.look("history.back()")
    page.until("document.getElementById('job-name').textContent === 'job 29'")
    page.look("history.back()")
    page.until("document.getElementById('job').hidden")
    page.look("history.go(2)")
    page.until("!document.getElementById('job').hidden && document.getElementById('job-name').textContent === 'job 03'")
    is_without_serious_findings(page)
    page.look("document.getElementById('older').click()")
    page.until("document.querySelectorAll('#jobs a').length === 5 && /26 to 30 of 30/.test(document.body.innerText)")
    page.look("document.getElementById('search').value = 'job 07'; document.getElementById('search').oninput()")
    page.until("document.querySelectorAll('#jobs a').length === 1")
    page.look(f"location.hash = '{'0' * 32}'")
    page.until(
        "/no such job here/.test(document.getElementById('problem').innerText) && document.getElementById('job').hidden"
    )
    page.look("location.hash = 'nonsense'")
    page.until("/#nonsense names no job/.test(document.getElementById('problem').innerText)")
    page.open(f"{api.url}/#{'1' * 32}")
    page.until("/no such job here/.test(document.getElementById('problem').innerText)")


def test_page__signs_in_and_out(tmp_path, page):
    api = ApiProcess(tmp_path / "data", require_tokens="true")
    try:
        page.open(api.url + "/")
        page.until("!document.getElementById('login').hidden")
        assert page.look("document.getElementById('problem').hidden")  # nothing is wrong before a token was tried
        page.look("document.getElementById('token').value = 'none'; document.querySelector('#login button').click()")
        page.until("/not known/.test(document.getElementById('problem').textContent)")
        is_without_serious_findings(page)
        page.look(
            f"document.getElementById('token').value = '{api.token('ann')}'; document.querySelector('#login button').click()"
        )
        page.until("document.getElementById('login').hidden && document.getElementById('owner').textContent === 'ann'")
        page.look("document.getElementById('account').open = true")
        page.until("document.querySelectorAll('#tokens li').length === 1")
        page.look(
            "document.getElementById('token-label').value = 'laptop'; document.getElementById('token-days').value = 2;"
            "document.querySelector('#new-token button').click()"
        )
        page.until(
            "document.querySelectorAll('#tokens li').length === 2 && /good until/.test(document.getElementById('tokens').textContent)"
        )
        made = page.until("document.querySelector('#made-token code')?.textContent")
        with httpx.Client(base_url=api.url, headers={"Authorization": f"Bearer {made}"}) as laptop:
            assert laptop.get("/web-state").json()["owner"] == "ann"
            is_without_serious_findings(page)
            page.look("window.confirm = () => true; document.querySelector('[aria-label=\"Revoke laptop\"]').click()")
            page.until("document.querySelectorAll('#tokens li').length === 1")
            page.until("/DELETE tokens/.test(document.getElementById('audit').textContent)")
            assert laptop.get("/web-state").status_code == 401
        page.look("document.getElementById('sign-out').click()")
        page.until("!document.getElementById('login').hidden && document.getElementById('sign-out').hidden")
        assert page.look("sessionStorage.getItem('token')") is None
    finally:
        api.kill()


def test_page__estimates_measures_and_deletes(tmp_path, page, large):
    with service(tmp_path / "data", workers=1) as served:
        page.open(served.url + "/")
        page.until("document.querySelectorAll('#options input').length")
        page.choose_file("#file", large)
        uploaded(page)
        page.look(
            "document.getElementById('preset').value = 'draft'; document.querySelector('[name=iterations]').value = 1"
        )
        page.look("document.querySelector('[name=dictionary]').value = 'own'")  # which has a curve of learning
        page.look("document.getElementById('estimate').click()")
        page.until("/texture PSNR/.test(document.getElementById('estimated').innerText)")
        assert "to" in text(page, "estimated") and text(page, "problem") == ""
        page.look("document.getElementById('name').value = 'first of all'; document.getElementById('start').click()")
        page.until("document.getElementById('job-name').textContent === 'first of all'")
        page.until("document.getElementById('job-state').className === 'successful'")
        page.until("[...document.querySelectorAll('#pair img')].every((i) => i.complete && i.naturalWidth)")
        assert page.look("document.querySelector('#all a').href.endsWith('/archive')") and ".zip" in text(page, "all")
        assert "measured at the end" in text(page, "curve-caption")
        is_without_serious_findings(page)
        page.picture(tmp_path / "light.png")
        page.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": "dark"}])
        page.call("Emulation.setDeviceMetricsOverride", width=360, height=800, deviceScaleFactor=1, mobile=True)
        assert page.look("document.documentElement.scrollWidth") == 360  # nothing is cut off on a telephone
        page.picture(tmp_path / "dark.png")
        page.look("window.confirm = () => true; document.getElementById('delete-scan').click()")
        page.until("document.getElementById('scan').options.length === 0 && document.getElementById('start').disabled")
        assert page.complaints == []
