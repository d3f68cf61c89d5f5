"""What a failed job says."""

from __future__ import annotations

from services.jobs.workflow import JobRunner
from services.settings import settings_from
from services.store.store import Store
from services.uploads.scans import scan_path
from storage.errors import InvalidScan


def test_workflow__a_failed_job_names_its_scan_as_its_owner_does(tmp_path, monkeypatch):
    settings = settings_from({}, data=tmp_path)
    store = Store(settings.database_url)
    scan = {"id": "0" * 64, "file": "head.nrrd", "path_name": "scan.nrrd", "bytes": 1, "header": {}}
    store.add_scan(scan, "anna")
    row = {"owner": "anna", "scan": scan["id"], "name": "head", "settings": {}, "webhook": None}
    job, _ = store.add_job(row | {"request_key": None, "request_hash": ""}, 9)
    where = scan_path(settings, store.scan(scan["id"], "anna"))

    def fail(*_):
        raise InvalidScan(f"{where}:sizes", "none", "some")

    monkeypatch.setattr(JobRunner, "_make", fail)
    assert JobRunner(settings, store, str).run(job["id"], job["attempt"]) == "failed"
    ended = store.job(job["id"])
    assert ended["problem"]["class"] == "data" and ended["problem"]["detail"].startswith("head.nrrd:sizes")
    store.close()
