"""The embedded service as real processes: whole jobs over HTTP, and what happens when a part of it is killed."""

from __future__ import annotations

import json
import re
import threading
import time
import tomllib
import zipfile
from base64 import b64encode
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import httpx
import psutil
import pytest

from services.cli.client import Client, zip_folder
from services.cli.main import main
from tests.services.chromium import Page, chromium_path
from tests.services.scans import packed_by_compress, photo_scan
from tests.services.service_process import service, until

OPTIONS = {"dictionary": "own", "target_psnr_db": 32.0, "training_splats": 2000, "iterations": 2, "effects": "pages=on"}
LONG = {**OPTIONS, "iterations": 400}


@pytest.fixture(scope="module")
def scan(tmp_path_factory) -> Path:
    return photo_scan(tmp_path_factory.mktemp("scan") / "plane", n_side=60)


@pytest.fixture(scope="module")
def compressed(scan, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("expected") / "out"
    packed_by_compress(scan, out, OPTIONS)
    return out


@pytest.fixture(scope="module")
def expected(compressed) -> bytes:
    return (compressed / "plane.splatpress").read_bytes()


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    with service(tmp_path_factory.mktemp("service") / "data", performance_from_s="0.2") as started:
        yield started


@pytest.fixture(scope="module")
def uploaded(served, scan) -> str:
    return served.client.upload(scan)["id"]


def packed(served, job: str, out: Path) -> bytes:
    served.client.fetch(job, out, ["plane.splatpress"])
    return (out / "plane.splatpress").read_bytes()


def test_service__a_job_over_http_packs_the_bytes_of_compress_and_makes_every_artifact(
    served, uploaded, compressed, expected, tmp_path
):
    events = []
    job = served.client.submit(uploaded, preset="draft", options=OPTIONS)
    ended = served.client.watch(job["jobID"], events.append)
    assert ended["status"] == "successful" and ended["progress"] == 100 and ended["expires_at"] > ended["finished"]
    assert "CRITICAL" not in served.log.read_text() and "Traceback" not in served.log.read_text()
    assert packed(served, job["jobID"], tmp_path) == expected
    (pages,) = served.client.fetch(job["jobID"], tmp_path, ["plane.pages"])
    assert pages.read_bytes() == (compressed / "plane.pages").read_bytes()
    names = {a["name"] for a in served.client.artifacts(job["jobID"])}
    assert {
        "plane.splatpress",
        "report.html",
        "report.json",
        "learning.json",
        "dask-performance.html",
        "previews/0000.packed.png",
        "previews/0000.baseline.png",
    } <= names
    found = httpx.get(f"{served.url}/v1/scans/{uploaded}").json()
    assert found["bounds"]["min"][:2] == pytest.approx([-0.8, -0.6]) and found["bounds"]["max"][:2] == pytest.approx(
        [0.8, 0.6]
    )
    assert {row["effect"] for row in found["effects"]} > {"cliplines"} and all(
        row["reason"] for row in found["effects"]
    )
    percents = [e["data"]["progress"] for e in events if e["kind"] == "progress"]
    assert percents == sorted(percents) and percents[-1] > 90
    assert [e["data"]["status"] for e in events if e["kind"] == "status"] == ["accepted", "running", "successful"]
    learned = [e["data"]["psnr_db"] for e in events if e["kind"] == "learning"]
    assert len(learned) == 1 and learned == [
        p["psnr_db"] for p in json.loads(served.client.fetch(job["jobID"], tmp_path, ["learning.json"])[0].read_text())
    ]
    assert {"ksvd-update", "render"} <= {e["data"]["stage"] for e in events if e["kind"] == "progress"}


def test_service__a_worker_makes_exports_when_they_are_asked_for(served, uploaded, expected, tmp_path):
    job = next(job["jobID"] for job in served.client.ls(status="successful"))
    address = f"{served.url}/v1/jobs/{job}/artifacts"
    first = httpx.get(address, params={"format": "spz"})
    assert first.status_code == 202 and first.headers["retry-after"] == "1" and first.json() == {"artifacts": []}
    made = served.client.export(job, "spz")
    assert made["name"] == "exports/plane.spz"
    assert made in served.client.artifacts(job) and served.client.export(job, "spz") == made
    (tmp_path / "plane.splatpress").write_bytes(expected)
    assert main(["export", str(tmp_path / "plane.splatpress"), "--to", "spz"]) == 0
    fetched = served.client.fetch(job, tmp_path, [made["name"]])
    assert fetched[0].read_bytes() == (tmp_path / "plane.spz").read_bytes()
    said = " ".join(line["message"] for line in served.client.logs(job))
    assert "export as spz:" in said and "export as spz loses textures of" in said


def test_service__a_tradeoff_is_a_job_too(served, uploaded, tmp_path):
    job = served.client.submit(uploaded, process="tradeoff", preset="draft", options=OPTIONS, knobs={}, budget_s=0.01)[
        "jobID"
    ]
    ended = served.client.watch(job, lambda event: None)
    assert ended["status"] == "successful" and ended["processID"] == "tradeoff"
    served.client.fetch(job, tmp_path, ["tradeoff.json", "tradeoff.html"])
    document = json.loads((tmp_path / "tradeoff.json").read_text())
    assert (
        [p["key"] for p in document["points"]] == ["chosen"]
        and document["points"][0]["frame_seconds"] > 0
        and document["skipped"]
    )
    assert not [a for a in served.client.artifacts(job) if a["name"].startswith("packed/")]


def test_service__events_are_replayed_from_the_last_id_that_was_heard(served, uploaded):
    job = served.client.ls(status="successful")[0]["jobID"]
    everything: list[dict] = []
    served.client.watch(job, everything.append)
    middle = everything[len(everything) // 2]["id"]
    answer = httpx.get(f"{served.url}/v1/jobs/{job}/events", headers={"Last-Event-ID": middle})
    ids = [line[4:] for line in answer.text.splitlines() if line.startswith("id: ")]
    assert ids == [e["id"] for e in everything if int(e["id"]) > int(middle)] and len(ids) > 3


def test_service__a_port_in_use_is_said_and_not_tried_again(served, tmp_path, capsys):
    port = served.url.rpartition(":")[2]
    assert main(["serve", "--data", str(tmp_path / "data"), "--port", port]) == 2
    assert "already in use" in capsys.readouterr().err


def test_service__artifacts_come_in_ranges(served):
    jobs = [job["jobID"] for job in served.client.ls(status="successful")]
    job = next(id for id in jobs if any(a["name"] == "plane.splatpress" for a in served.client.artifacts(id)))
    found = next(a for a in served.client.artifacts(job) if a["name"] == "plane.splatpress")
    whole = httpx.get(served.url + found["href"]).content
    part = httpx.get(served.url + found["href"], headers={"Range": "bytes=100-199"})
    assert (
        part.status_code == 206
        and part.content == whole[100:200]
        and part.headers["content-range"] == f"bytes 100-199/{len(whole)}"
    )


def test_service__the_same_job_submitted_ten_times_at_once_is_one_and_ends_once(served, uploaded, expected, tmp_path):
    found = []

    def submit():
        with Client(served.url) as client:
            found.append(
                client.submit(uploaded, key="ten at once".replace(" ", "-"), preset="draft", options=OPTIONS)["jobID"]
            )

    threads = [threading.Thread(target=submit) for _ in range(10)]
    [t.start() for t in threads]
    [t.join() for t in threads]
    assert len(found) == 10 and len(set(found)) == 1
    events = []
    assert served.client.watch(found[0], events.append)["status"] == "successful"
    assert [e["data"]["status"] for e in events if e["kind"] == "status"] == ["accepted", "running", "successful"]
    assert packed(served, found[0], tmp_path) == expected


def test_service__a_dismissed_job_stops_within_ten_seconds_and_keeps_what_it_made(served, uploaded):
    job = served.client.submit(uploaded, preset="draft", options={**LONG, "target_psnr_db": 33.0})["jobID"]
    served.event(job, "learning", lambda data: data["iteration"] == 2)
    assert served.client.cancel(job)["status"] == "dismissed"
    until(lambda: "what it made so far stays" in served.log_of(job))
    before = [w.cpu_times().user for w in served.workers()]
    time.sleep(2)
    assert sum(w.cpu_times().user for w in served.workers()) - sum(before) < 1.0
    assert "learning.json" in {a["name"] for a in served.client.artifacts(job)}
    with pytest.raises(Exception) as again:
        served.client.cancel(job)
    assert again.value.status == 410 and served.client.status(job)["status"] == "dismissed"


def test_service__a_job_survives_the_death_of_a_worker_and_of_the_runner(served, uploaded, scan, tmp_path):
    options = {**OPTIONS, "iterations": 8, "target_psnr_db": 31.0}
    job = served.client.submit(uploaded, preset="draft", options=options)["jobID"]
    served.event(job, "learning", lambda data: data["iteration"] == 1)
    served.kill(max(served.workers(), key=lambda w: w.cpu_percent(0.3)))
    served.event(job, "learning", lambda data: data["iteration"] == 2)
    served.kill(served.part("runner"))
    events = []
    ended = served.client.watch(job, events.append)
    assert ended["status"] == "successful", ended["problem"]
    log = served.log_of(job)
    assert "the runner was started anew and goes on" in log
    assert log.count("resample: ") == 1 and log.count("ksvd-update: ") <= 9  # what was done was not done again
    assert [e["data"]["status"] for e in events if e["kind"] == "status"] == ["accepted", "running", "successful"]
    assert packed(served, job, tmp_path) == packed_by_compress(scan, tmp_path / "out", options)


def test_service__a_render_worker_that_dies_in_a_picture_is_replaced_and_the_pictures_are_the_same(served, tmp_path):
    scan = served.client.upload(photo_scan(tmp_path / "plane", n_side=40, n_cameras=12))["id"]
    job = served.client.submit(scan, preset="draft", options=OPTIONS)["jobID"]
    until(lambda: list((served.data / "jobs" / job).rglob("*.packed.png")), every=0.01)
    render_worker = served.render_worker()
    served.kill(render_worker)
    events = []
    ended = served.client.watch(job, events.append)
    assert ended["status"] == "successful", ended["problem"]
    assert re.search(r"worker \S+ was lost with 1 task.* of render; they run again", served.log_of(job))
    assert [e["data"]["status"] for e in events if e["kind"] == "status"] == ["accepted", "running", "successful"]
    assert served.render_worker().pid != render_worker.pid
    again = served.client.submit(scan, preset="draft", options=OPTIONS)["jobID"]
    served.client.watch(again, lambda event: None)
    pictures = [
        {a["name"]: a["sha256"] for a in served.client.artifacts(id) if a["name"].endswith((".png", ".splatpress"))}
        for id in (job, again)
    ]
    assert len(pictures[0]) == 25 and pictures[0] == pictures[1]


def test_service__ten_equal_jobs_without_a_key_are_ten_and_share_what_they_make(served, tmp_path):
    id = served.client.upload(photo_scan(tmp_path / "ten", n_side=24))["id"]

    def submit(_: int) -> str:
        request = {"scan": id, "preset": "draft", "options": {**OPTIONS, "iterations": 1}}
        return httpx.post(served.url + "/v1/jobs", json=request, timeout=300).json()["jobID"]

    with ThreadPoolExecutor(10) as pool:
        jobs = list(pool.map(submit, range(10)))
    assert len(set(jobs)) == 10
    assert {served.client.watch(job, lambda event: None)["status"] for job in jobs} == {"successful"}
    logs = [served.log_of(job) for job in jobs]
    assert (
        sum(bool(re.search(r"resample: [0-9.]+ s", log)) for log in logs) == 1
    )  # the others waited for it and took it
    hashes = {a["sha256"] for job in jobs for a in served.client.artifacts(job) if a["name"] == "ten.splatpress"}
    assert len(hashes) == 1


def test_service__a_job_dismissed_in_a_reduction_whose_worker_hangs_stops_and_a_retry_packs_the_same(served, tmp_path):
    """The worker is frozen between the last task of a k-SVD update and its summary: there `finalise` runs."""
    scan, options = photo_scan(tmp_path / "frozen", n_side=40), {**OPTIONS, "iterations": 6}
    scan_id = served.client.upload(scan)["id"]
    job = served.client.submit(scan_id, preset="draft", options=options)["jobID"]
    frozen = _frozen_in_a_reduction(served, served.data / "work" / scan_id)
    try:
        served.client.cancel(job)
        until(lambda: "what it made so far stays" in served.log_of(job))
        left = [
            w for w in frozen if psutil.pid_exists(w.pid) and w.is_running() and w.status() == psutil.STATUS_STOPPED
        ]
    finally:
        for worker in frozen:
            with suppress(psutil.NoSuchProcess):
                worker.resume()
    assert len(left) < len(frozen)  # the one that had it was ended
    served.client.retry(job)
    assert served.client.watch(job, lambda event: None)["status"] == "successful"
    served.client.fetch(job, tmp_path, ["frozen.splatpress"])
    assert (tmp_path / "frozen.splatpress").read_bytes() == packed_by_compress(scan, tmp_path / "out", options)


def _frozen_in_a_reduction(served, work: Path) -> list:
    workers = served.workers()
    deadline = time.monotonic() + 300
    while time.monotonic() < deadline:
        for folder in work.glob("ksvd-update-*[!k]"):
            if (folder / "results" / "000000.json").exists() and not (folder / "summary.json").exists():
                [w.suspend() for w in workers]
                time.sleep(0.2)  # what the runner may have been told before
                if not (folder / "summary.json").exists():
                    return workers
                [w.resume() for w in workers]
        time.sleep(0.002)
    raise AssertionError("no reduction was met")


def test_service__an_upload_goes_on_where_a_killed_api_left_it(served, scan, tmp_path):
    path = tmp_path / "again.zip"
    zip_folder(scan, path)
    content = path.read_bytes()
    tus = {"Tus-Resumable": "1.0.0"}
    made = httpx.post(
        served.url + "/v1/uploads",
        headers={
            **tus,
            "Upload-Length": str(len(content)),
            "Upload-Metadata": "filename " + b64encode(b"again.zip").decode(),
        },
    )
    where = served.url + made.headers["Location"]
    half = len(content) // 2

    def dripping():
        yield content[:half]
        until(lambda: any(p.stat().st_size for p in (served.data / "uploads").rglob("*.zip")))
        served.kill(served.part("api"))
        yield content[half : half + 1]
        time.sleep(1)
        yield content[half + 1 :]

    patch = {**tus, "Content-Type": "application/offset+octet-stream"}
    with pytest.raises(httpx.TransportError):
        httpx.patch(where, content=dripping(), headers={**patch, "Upload-Offset": "0"}, timeout=300)
    until(served.is_ready)
    offset = int(httpx.head(where, headers=tus).headers["Upload-Offset"])
    assert 0 < offset <= half + 1
    done = httpx.patch(where, content=content[offset:], headers={**patch, "Upload-Offset": str(offset)}, timeout=300)
    assert done.status_code == 204 and len(done.headers["Splatpress-Scan"]) == 64
    assert not list((served.data / "uploads").iterdir())


@pytest.mark.skipif(chromium_path() is None, reason="needs Chromium (apt-get install chromium)")
def test_service__the_page_uploads_runs_and_shows_a_job(served, scan, tmp_path):
    other = tmp_path / "from the page.zip"
    zip_folder(scan, other)
    with zipfile.ZipFile(other, "a") as archive:
        archive.writestr("note.txt", "another content, so another scan")
    page = Page(tmp_path / "profile")
    try:
        page.open(served.url + "/")
        page.until("document.querySelectorAll('#options input').length >= 7")
        page.choose_file("#file", other)
        page.until("/3,600 points, 3 photographs/.test(document.getElementById('upload-state').textContent)")
        page.look(
            "document.getElementById('preset').value = 'draft'; document.querySelector('[name=iterations]').value = 3"
        )
        page.look("document.querySelector('[name=dictionary]').value = 'own'")
        page.look("document.querySelector('[name=archive]').value = 'on'")
        page.look("document.getElementById('start').click()")
        page.until("/%/.test(document.getElementById('job-live').textContent)")
        page.until("/ksvd-update/.test(document.getElementById('log').textContent)")
        page.until("document.querySelector('#curve polyline')?.points.length >= 2")
        page.until("document.getElementById('job-state').className === 'successful'")
        page.until("[...document.querySelectorAll('#pair img')].every((i) => i.complete && i.naturalWidth === 320)")
        slider = "const s = document.getElementById('slider'); s.value = 20; s.oninput(); document.getElementById('packed').style.clipPath"
        assert "80%" in page.look(slider)
        text = page.look("document.body.innerText")
        for words in ("texture PSNR", "dB", "report.html", ".splatpress", "learning.json", "against the baseline"):
            assert words in text
        assert page.look("!document.getElementById('dashboard').hidden")
        page.picture(tmp_path / "page.png")
        assert page.complaints == []
        page.look("document.querySelector('a.look').click()")
        page.until("window.viewer && viewer.complete && viewer.splats > 0")  # of the archive's plain form
        assert page.look("document.getElementById('problem').textContent") == "" and page.complaints == []
        assert page.look("viewer.source.url.pathname").endswith(".plain.splatpress")
        page.picture(tmp_path / "viewer.png")
        page.open(served.url + "/docs")
        page.until("/POST \\/v1\\/jobs/.test(document.body.innerText)")
        page.open(served.url + "/dashboard/status")  # Dask's, passed on with its live messages
        page.until("Bokeh.documents[0].roots().length > 0 && document.querySelectorAll('.bk-Figure').length > 0")
        assert page.complaints == []
    finally:
        page.close()


def test_service__the_command_line_does_it_all(served, scan, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("SPLATPRESS_URL", served.url)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))

    said: list[str] = []

    def run(*arguments) -> tuple[int, str]:
        code = main([str(a) for a in arguments])
        out, err = capsys.readouterr()
        said.append(err)
        return code, out.strip()

    assert run("login", "--url", served.url, "--token", "")[0] == 0
    with httpx.Client(base_url=served.url) as api:  # the service is that of all tests here
        of_others = {job["jobID"] for job in api.get("/v1/jobs", params={"status": "dismissed"}).json()["jobs"]}
    code, listed = run("ls", "--status", "dismissed")
    assert code == 0 and (
        all(job in listed for job in of_others) if of_others else "no jobs that are dismissed" in said[-1]
    )
    code, id = run("upload", scan)
    assert code == 0 and len(id) == 64
    options = [f"--option={name}={value}" for name, value in OPTIONS.items()]
    code, last = run("submit", id, "--preset", "draft", *options, "--watch")
    job, status = last.split()
    assert code == 0 and status == "successful" and f"next: splatpress fetch {job} --out DIR" in said[-1]
    assert "progress: 100" in run("status", job)[1] and "encode: " in run("logs", job)[1] and job in run("ls")[1]
    assert run("fetch", job, "report.json", "--out", tmp_path / "got")[1] == str(tmp_path / "got" / "report.json")
    assert run("fetch", job, "nothing", "--out", tmp_path / "got")[0] == 2
    assert [p.name for p in (tmp_path / "got").iterdir()] == ["report.json"]
    fetched = run("fetch", job, "--out", tmp_path / "all")[1]
    assert "report.html" in fetched and "dask-performance.html" not in fetched
    assert run("status", "0" * 32)[0] == 1 and said[-1].startswith(
        "splatpress: no such job: service answered 404: no job 0"
    )
    assert run("retry", job)[0] == 1 and run("cancel", job) == (0, f"{job} dismissed")
    assert run("submit", id, "--option", "iterations=0")[0] == 1 and run("submit", id, "--option", "iterations")[0] == 1


def test_service__regress_updates_a_list_holds_it_and_exits_with_7_on_a_miss(
    served, scan, tmp_path, capsys, monkeypatch
):
    monkeypatch.setenv("SPLATPRESS_URL", served.url)
    jobs = tmp_path / "jobs.toml"
    jobs.write_text(f"""# kept
[[job]]
name = "plane"
scan = "{scan}"
preset = "draft"
options = {{ target_psnr_db = 32.0, training_splats = 2000, iterations = 2 }}
""")
    assert main(["regress", str(jobs), "--update"]) == 0
    assert (
        jobs.read_text().startswith("# kept")
        and tomllib.loads(jobs.read_text())["job"][0]["expected"]["file_bytes"] > 1000
    )
    figures = tomllib.loads(jobs.read_text())["job"][0]["expected"]
    jobs.write_text(re.sub(r"seconds = [0-9.]+", "seconds = 9999.0", jobs.read_text()))
    assert main(["regress", str(jobs)]) == 0
    jobs.write_text(jobs.read_text().replace(f"psnr_db = {figures['texture_psnr_db']}", "psnr_db = 70.0"))
    assert main(["regress", str(jobs)]) == 7
    assert "MISSED" in capsys.readouterr().out
