"""Backups: taken while a job runs, restored elsewhere with nothing else at hand, and the job goes on to the same
bytes."""

from __future__ import annotations

import os
import stat

import pytest

from services.cli.client import Client
from services.cli.main import main
from services.jobs.backup import back_up, restore
from services.jobs.disk import make_data_folder
from services.settings import ServiceSettings, settings_from
from services.store.rows import ArtifactRow, NewJob
from services.store.store import Store
from services.uploads.scans import accept_scan
from storage.errors import InvalidPackedFile, ResourceExhausted, SplatpressError
from tests.services.scans import packed_by_compress, photo_scan, point_scan
from tests.services.service_process import service
from tests.services.store.test_migrate import postgres, url  # noqa: F401 (fixtures)

OPTIONS = {"dictionary": "own", "target_psnr_db": 32.0, "training_splats": 2000}
LONG = {**OPTIONS, "iterations": 60, "least_gain_db": 0.0}


def test_backup__of_a_running_service_is_all_that_another_machine_needs(tmp_path, capsys):
    scan = photo_scan(tmp_path / "plane", n_side=40)
    with service(tmp_path / "data", workers=1, require_tokens="true") as first:
        store = Store(f"sqlite:///{tmp_path / 'data' / 'splatpress.sqlite'}")
        token = store.add_token("ann")
        store.close()
        first.client = Client(first.url, token)
        id = first.client.upload(scan)["id"]
        done = first.client.submit(id, preset="draft", options={**OPTIONS, "iterations": 2})["jobID"]
        assert first.client.watch(done, lambda event: None)["status"] == "successful"
        before = {a["name"]: a["sha256"] for a in first.client.artifacts(done)}
        running = first.client.submit(id, preset="draft", options=LONG)["jobID"]
        first.event(running, "learning", lambda data: data["iteration"] == 2)
        assert main(["backup", str(tmp_path / "b.tar"), "--data", str(tmp_path / "data")]) == 0
        assert first.client.status(running)["status"] == "running"
        first.client.cancel(running)
    assert stat.S_IMODE(os.stat(tmp_path / "b.tar").st_mode) == 0o600
    os.rename(tmp_path / "data", tmp_path / "gone")
    assert main(["restore", str(tmp_path / "b.tar"), "--data", str(tmp_path / "elsewhere" / "data")]) == 0
    assert "1 scans, 2 jobs" in capsys.readouterr().out
    with service(tmp_path / "elsewhere" / "data", workers=1, require_tokens="true") as second:
        second.client = Client(second.url, token)
        ended = second.client.watch(running, lambda event: None)
        assert ended["status"] == "successful", ended["problem"]
        second.client.fetch(running, tmp_path / "got", ["plane.splatpress"])
        assert {a["name"]: a["sha256"] for a in second.client.artifacts(done)} == before
        assert len(second.client.fetch(done, tmp_path / "old")) == len(before)
        assert second.client.upload(scan)["id"] == id
    assert (tmp_path / "got" / "plane.splatpress").read_bytes() == packed_by_compress(scan, tmp_path / "out", LONG)


@pytest.fixture
def filled(tmp_path):
    """A data folder with a scan, a job that ended and an upload under way."""
    settings = settings_from({}, data=tmp_path / "data")
    make_data_folder(settings)
    store = Store(settings.database_url)
    scan, _ = accept_scan(point_scan(tmp_path / "ball.ply", 50), "ann", settings, store)
    job, _ = store.add_job(NewJob("ann", scan.id, "n", {}, "compress"), 10)
    made = settings.data / "jobs" / job.id / "attempt-1" / "report.json"
    made.parent.mkdir(parents=True)
    made.write_text("{}")
    store.begin(job.id, 1)
    store.end(job.id, 1, "successful", [ArtifactRow("report.json", "attempt-1/report.json", 2, "0" * 64)])
    store.add_upload("ann", "a.zip", 9, "", 1e12)
    store.close()
    return settings


def test_backup__is_restored_into_either_database_and_ids_go_on_behind_the_old_ones(filled, tmp_path, url):  # noqa: F811
    made = back_up(filled, tmp_path / "b.tar")
    assert made.rows["jobs"] == 1 and made.rows["uploads"] == 0 and made.n_files == 2 and made.missing == ()
    settings = settings_from({}, data=tmp_path / "new", database=url)
    assert restore(settings, tmp_path / "b.tar") == made
    old, new = Store(filled.database_url), Store(url)
    id = old.jobs("ann", 1, 0)[0][0].id
    assert (
        new.job(id) == old.job(id) and new.events(id, 0) == old.events(id, 0) and new.artifacts(id) == old.artifacts(id)
    )
    assert new.scans("ann", 9, 0) == old.scans("ann", 9, 0)
    new.log(id, "info", "and on")
    assert new.events(id, 0)[-1].id > old.events(id, 0)[-1].id
    assert (settings.data / "jobs" / id / "attempt-1" / "report.json").read_text() == "{}"
    assert not list(settings.data.glob("*restored*")) and not (settings.data / "backup.json").exists()
    old.close(), new.close()
    with pytest.raises(SplatpressError, match="rows in"):
        restore(settings_from({}, data=tmp_path / "third", database=url), tmp_path / "b.tar")


def test_backup__what_is_cut_off_or_none_at_all_is_refused(filled, tmp_path):
    back_up(filled, tmp_path / "b.tar")
    whole = (tmp_path / "b.tar").read_bytes()
    for i, n in enumerate([0, 100, 512, len(whole) // 3, len(whole) // 2, len(whole) - 11_000]):
        (tmp_path / "cut.tar").write_bytes(whole[:n])
        with pytest.raises(InvalidPackedFile, match="no whole backup"):
            restore(settings_from({}, data=tmp_path / f"r{i}"), tmp_path / "cut.tar")


def test_backup__goes_into_an_empty_folder_alone_and_leaves_no_half(filled, tmp_path):
    back_up(filled, tmp_path / "b.tar")
    with pytest.raises(ResourceExhausted, match="not empty"):
        restore(filled, tmp_path / "b.tar")
    with pytest.raises(OSError):
        back_up(filled, tmp_path / "nowhere" / "b.tar")
    assert sorted(p.name for p in tmp_path.iterdir() if "partial" in p.name) == []


def test_backup__says_which_files_were_not_there(filled, tmp_path, capsys):
    for path in (filled.data / "jobs").rglob("report.json"):
        path.unlink()
    assert main(["backup", str(tmp_path / "b.tar"), "--data", str(filled.data)]) == 0
    assert "report.json is named by the database and not there" in capsys.readouterr().err


def test_data__a_folder_of_a_newer_program_is_refused(tmp_path, capsys):
    make_data_folder(ServiceSettings(data=tmp_path / "data"))
    (tmp_path / "data" / "version").write_text("2\n")
    assert main(["serve", "--data", str(tmp_path / "data")]) == 2
    assert "a data folder of version '2'; allowed: up to 1" in capsys.readouterr().err
