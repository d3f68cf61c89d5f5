"""Data in a bucket: a whole service whose scans, work folders and results lie there, before a server that stumbles."""

from __future__ import annotations

from pathlib import Path

import pytest

from services.settings import ServiceSettings, environment_of, settings_from
from tests.services.bucket import BUCKET, bucket_environment, s3_server, stumbling_proxy
from tests.services.scans import packed_by_compress, photo_scan
from tests.services.service_process import service, until

OPTIONS = {"dictionary": "own", "target_psnr_db": 32.0, "training_splats": 1000, "iterations": 3}
CACHE_BYTES = 8 << 20  # of each process; the patches of 2,304 splats alone are 7 MB


def test_settings__a_bucket_is_named_by_data_and_children_are_told_the_same(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = settings_from({"SPLATPRESS_DATA": "s3://scans/a/b", "SPLATPRESS_STATE": "here"})
    assert found.place == Path("s3://scans/a/b") and found.data == tmp_path / "here"
    assert found.database_url == f"sqlite:///{tmp_path}/here/splatpress.sqlite"
    again = settings_from(environment_of(found))
    assert (again.place, again.data) == (found.place, found.data)
    assert settings_from({}, data=Path("s3://scans/a")).place == Path("s3://scans/a")
    plain = ServiceSettings(data=tmp_path)
    assert plain.place == plain.data == tmp_path
    with pytest.raises(ValueError, match="s3://BUCKET/PREFIX"):
        settings_from({"SPLATPRESS_DATA": "s3://scans"})


def test_bucket__a_job_packs_the_bytes_of_compress_though_a_worker_dies_and_requests_are_cut(tmp_path, monkeypatch):
    """Every 20th request is refused (503) or cut off. Each worker has a folder of its own."""
    scan = photo_scan(tmp_path / "plane", n_side=48)
    with s3_server() as server, stumbling_proxy(server) as proxy:
        for name, value in bucket_environment(proxy.port).items():
            monkeypatch.setenv(name, value)
        monkeypatch.setenv("SPLATPRESS_CACHE", str(tmp_path / "cache"))
        monkeypatch.setenv("SPLATPRESS_CACHE_BYTES", str(CACHE_BYTES))
        with service(tmp_path / "data", objects=f"s3://{BUCKET}/splats", log=tmp_path / "log") as served:
            id = served.client.upload(scan)["id"]
            job = served.client.submit(id, preset="draft", options=OPTIONS)["jobID"]
            served.event(job, "learning", lambda data: True)
            served.kill(served.workers()[0])
            ended = served.client.watch(job, lambda event: None)
            assert ended["status"] == "successful", (ended["problem"], served.log_of(job))
            names = {path.name for path in served.client.fetch(job, tmp_path / "got")}
            assert {"plane.splatpress", "report.html", "0000.packed.png"} <= names
            used = {
                f: sum(p.stat().st_size for p in f.rglob("*") if p.is_file()) for f in (tmp_path / "cache").iterdir()
            }
            assert len(used) >= 4 and max(used.values()) <= CACHE_BYTES and sum(used.values()) > CACHE_BYTES // 2
            assert not [p for name in ("scans", "work", "jobs") for p in (served.data / name).rglob("*") if p.is_file()]
            format = {"format": "ply"}
            until(lambda: served.client._http.get(f"/v1/jobs/{job}/artifacts", params=format).status_code == 200)
            assert served.client._http.delete(f"/v1/jobs/{job}").is_success
        left = _names(server)
        assert proxy.stumbles > 10 and min(proxy.busy, proxy.cut_before, proxy.cut_after) > 0
    assert (tmp_path / "got" / "plane.splatpress").read_bytes() == packed_by_compress(scan, tmp_path / "out", OPTIONS)
    assert f"splats/scans/{id}/scan.zip" in left
    assert [name for name in left if name.startswith(f"splats/jobs/{job}/")] == [f"splats/jobs/{job}/dismissed-1"]


def _names(port: int) -> list[str]:
    import boto3

    keys = {"aws_access_key_id": "test", "aws_secret_access_key": "test", "region_name": "us-east-1"}
    listed = boto3.client("s3", endpoint_url=f"http://127.0.0.1:{port}", **keys).list_objects_v2(Bucket=BUCKET)
    return [entry["Key"] for entry in listed.get("Contents", [])]
