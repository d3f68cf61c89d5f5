"""A bucket that is gone or closed to the service is no mistake of its code, nor a fault of a scan."""

from __future__ import annotations

import errno

import pytest
from fastapi.testclient import TestClient

from services.api.app import create_app
from services.settings import settings_from
from services.store.store import Store
from storage.place.objects import worth_another


def test_objects__a_bucket_that_is_gone_is_told_from_an_object_that_is_not_there():
    with pytest.raises(OSError, match="the object store: the bucket is not there") as caught:
        worth_another(FileNotFoundError("404 <Code>NoSuchBucket</Code>"), False, "s3://scans/a")
    assert caught.value.errno == errno.EIO
    assert not worth_another(FileNotFoundError("404 <Code>NoSuchKey</Code>"), False, "s3://scans/a")


@pytest.mark.parametrize(
    ("said", "status", "kind"), [("the object store: 403", 503, "resource"), ("something else", 500, "internal")]
)
def test_objects__the_api_says_whose_turn_it_is(tmp_path, monkeypatch, said, status, kind):
    def fail(*_, **__):
        raise OSError(errno.EIO, said, "s3://scans/a")

    app = create_app(settings_from({}, data=tmp_path))
    monkeypatch.setattr(Store, "scans", fail)
    with TestClient(app, base_url="http://127.0.0.1", raise_server_exceptions=False) as api:
        found = api.get("/v1/scans")
    assert (found.status_code, found.json()["class"]) == (status, kind) and "s3://" not in found.text
