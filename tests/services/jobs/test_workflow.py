"""What a failed job says."""

from __future__ import annotations

from services.jobs.workflow import JobRunner
from services.settings import settings_from
from services.store.rows import NewJob, ScanRow
from services.store.store import Store
from services.uploads.scans import scan_path
from storage.errors import InvalidScan


def test_workflow__a_failed_job_names_its_scan_as_its_owner_does(tmp_path, monkeypatch):
    settings = settings_from({}, data=tmp_path)
    store = Store(settings.database_url)
    scan = ScanRow("0" * 64, "head.nrrd", "scan.nrrd", 1, {}, 0.0)
    store.add_scan(scan, "anna")
    job, _ = store.add_job(NewJob("anna", scan.id, "head", {}, "compress"), 9)
    where = scan_path(settings, store.scan(scan.id, "anna"))

    def fail(*_):
        raise InvalidScan(f"{where}:sizes", "none", "some")

    monkeypatch.setattr(JobRunner, "_make", fail)
    assert JobRunner(settings, store, str).run(job.id, job.attempt) == "failed"
    ended = store.job(job.id)
    assert ended.problem["class"] == "data" and ended.problem["detail"].startswith("head.nrrd:sizes")
    store.close()
