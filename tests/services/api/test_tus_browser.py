"""The reference client of tus in a real browser against a real service: its own tests' ways to upload, and each side's
end.

Its browser build is put into a page of the service, so that requests are the page's own.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

from tests.services.chromium import Page, chromium_path
from tests.services.scans import padded_scan
from tests.services.service_process import ApiProcess, until

pytestmark = pytest.mark.skipif(chromium_path() is None, reason="needs Chromium (apt-get install chromium)")
MIB = 1 << 20
SCRIPT = """
const { stream, holdAt, previous, ...options } = OPTIONS;
window.said = [];
window.ended = null;
window.mayGoOn = false;
const file = document.getElementById("given").files[0];
const source = stream ? file.stream().getReader() : file;
const upload = new tus.Upload(source, {
  endpoint: "/v1/uploads",
  retryDelays: Array(400).fill(250),
  metadata: { filename: "large.zip" },
  onAfterResponse: async (request, answer) => {
    said.push({ method: request.getMethod(), status: answer.getStatus(), offset: Number(answer.getHeader("Upload-Offset")),
      scan: answer.getHeader("Splatpress-Scan") });
    while (said.at(-1).offset >= holdAt && !mayGoOn) await new Promise((done) => setTimeout(done, 50));
  },
  onError: (error) => { window.ended = { error: String(error) }; },
  onSuccess: () => { window.ended = { url: upload.url }; },
  ...options,
});
(previous ? upload.findPreviousUploads() : Promise.resolve([])).then((found) => {
  if (found.length) upload.resumeFromPreviousUpload(found[0]);
  upload.start();
});
1
"""


@pytest.fixture(scope="module")
def large(tmp_path_factory) -> Path:
    """A scan of 8 MB."""
    return padded_scan(tmp_path_factory.mktemp("large"), 8)


@pytest.fixture(scope="module")
def api(tmp_path_factory):
    started = ApiProcess(tmp_path_factory.mktemp("api") / "data", reserve_bytes="0")
    yield started
    started.kill()


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    opened = Page(tmp_path_factory.mktemp("browser") / "profile")
    yield opened
    opened.close()


def begin(page: Page, api: ApiProcess, modules: Path, file: Path, **options) -> None:
    """Load a page of the service anew, give it the client and the file, and start."""
    page.open("about:blank")
    page.open(api.url + "/docs")
    page.until("location.pathname === '/docs' && document.readyState === 'complete'")
    page.look((modules / "tus-js-client" / "dist" / "tus.min.js").read_text() + ";1")
    page.look("document.body.innerHTML = '<input id=given type=file>'; 1")
    page.choose_file("#given", file)
    assert (
        page.look(
            "(() => {" + SCRIPT.replace("OPTIONS", json.dumps(options)).replace("\n1\n", "\nreturn 1;\n") + "})()"
        )
        == 1
    )


def ended(page: Page, file: Path) -> list[dict]:
    """What the client heard of the service, once the upload is a scan."""
    assert "url" in page.until("window.ended"), page.look("window.ended")
    heard = page.look("window.said")
    scans = {row["scan"] for row in heard if row["scan"]}
    assert scans == {hashlib.sha256(file.read_bytes()).hexdigest()}
    return heard


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"chunkSize": 3 * MIB},
        {"uploadDataDuringCreation": True, "chunkSize": 3 * MIB},
        {"uploadLengthDeferred": True, "stream": True, "chunkSize": 2 * MIB},
        {"overridePatchMethod": True, "chunkSize": 5 * MIB},
        {"parallelUploads": 3},
        {"parallelUploads": 2, "chunkSize": MIB},
    ],
    ids=json.dumps,
)
def test_tus_browser__every_way_to_upload_ends_in_a_scan(page, api, modules, large, options):
    begin(page, api, modules, large, **options)
    heard = ended(page, large)
    assert all(row["status"] < 300 for row in heard), heard
    n_pieces = sum(row["method"] in ("PATCH", "POST") for row in heard)
    assert n_pieces >= -(-large.stat().st_size // options.get("chunkSize", large.stat().st_size))
    assert not list((api.data / "uploads").iterdir())


def on_disk(api: ApiProcess) -> int:
    return sum(p.stat().st_size for p in (api.data / "uploads").rglob("*") if p.is_file())


def test_tus_browser__goes_on_where_it_was_after_its_page_is_gone(page, api, modules, large):
    page.open(api.url + "/docs")
    page.look("localStorage.clear()")
    begin(page, api, modules, large, chunkSize=MIB, holdAt=3 * MIB)
    until(lambda: on_disk(api) >= 3 * MIB)
    begin(page, api, modules, large, chunkSize=MIB, previous=True)
    heard = ended(page, large)
    assert heard[0]["method"] == "HEAD" and heard[0]["offset"] >= 3 * MIB and "POST" not in {r["method"] for r in heard}


def test_tus_browser__goes_on_though_the_service_is_killed_and_started_anew(page, api, modules, large):
    begin(page, api, modules, large, chunkSize=MIB, holdAt=3 * MIB)
    until(lambda: on_disk(api) >= 3 * MIB)
    api.kill()
    page.look("window.mayGoOn = true")
    api.start()
    heard = ended(page, large)
    assert [row["method"] for row in heard].count("POST") == 1
    assert all(row["offset"] >= 3 * MIB for row in heard if row["method"] == "HEAD")
