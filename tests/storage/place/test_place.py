"""A bucket in place of a folder: the same arrays, files that are whole or not there, one holder, a cache that is
bounded."""

from __future__ import annotations

import errno
import re
from pathlib import Path

import numpy as np
import pytest
import zarr

from storage import place
from storage.place import cache, lease, objects
from storage.whole import whole
from storage.work import arrays, work
from tests.services.bucket import BUCKET, bucket_environment, s3_server, stumbling_proxy

BOUND = 1 << 20

DONE = work.TaskRecord({"n_splats": 4}, 4, 0.5, 0.25, 0.0, 1 << 20)


@pytest.fixture(scope="module")
def server():
    with s3_server() as port:
        yield port


def use(monkeypatch, port: int, folder: Path, bound: int = BOUND) -> None:
    """As another process would: the server at this port, and a cache of its own."""
    for name, value in bucket_environment(port).items():
        monkeypatch.setenv(name, value)
    objects._bucket.cache_clear()
    arrays.layout_of.cache_clear()
    folder.mkdir(parents=True)
    monkeypatch.setattr(cache, "_of_process", (cache.os.getpid(), cache.Cache(folder, bound)))


@pytest.fixture
def bucket(server, monkeypatch, tmp_path, request):
    use(monkeypatch, server, tmp_path / "cache")
    yield Path(f"s3://{BUCKET}/{request.node.name}")
    objects._bucket.cache_clear()
    arrays.layout_of.cache_clear()


def bytes_in(folder: Path) -> int:
    return sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())


def make_arrays(folder: Path) -> None:
    rng = np.random.default_rng(0)
    arrays.create(folder, "rows", (2500, 3), "float32", (1000, 3))
    arrays.write(folder, "rows", 0, rng.random((1000, 3), np.float32))
    arrays.write(folder, "rows", 2000, rng.random((500, 3), np.float32))  # the chunk between is never written
    arrays.create(folder, "picture", (70, 90, 3), "uint8", (32, 32, 3))
    arrays.write_picture(folder, "picture", rng.integers(0, 256, (70, 90, 3), np.uint8))
    arrays.store(folder, "stored", np.arange(999), (100,))
    appender = arrays.Appender(folder, "appended", (2,), "int32", 64)
    for n in (10, 100, 33):
        appender.append(rng.integers(0, 99, (n, 2), np.int32))
    appender.close()
    arrays.create(folder, "parted", (100,), "int64", (40,))
    arrays.write(folder, "parted", 5, np.arange(20))  # less than a chunk: through zarr
    work.write_parts(work.parts(folder) / "a.npz", x=np.arange(5))
    work.write_part(folder / "b.npy", np.arange(7))
    work.record_task(folder, 3, DONE)


def read_arrays(folder: Path) -> dict:
    found = {name: arrays.read(folder, name) for name in arrays.names(folder)}
    with work.open_parts(work.parts(folder) / "a.npz") as part:
        found["part"] = part["x"]
    return found | {
        "some": arrays.read_rows(folder, "rows", np.array([1, 999, 2400])),
        "window": arrays.read_window(folder, "picture", 20, 50, 30, 70),
        "pieces": np.concatenate([rows for _, rows in arrays.pieces(folder, "stored", 150, 420, 64)]),
        "mapped": work.map_part(folder / "b.npy"),
        "tasks": np.array([[i, r.n_splats] for i, r in work.finished_tasks(folder).items()]),
    }


def test_place__arrays_of_a_bucket_are_those_of_a_folder_for_another_process_too(bucket, server, monkeypatch, tmp_path):
    local = tmp_path / "local"
    work.begin(local)
    make_arrays(local)
    make_arrays(bucket)
    use(monkeypatch, server, tmp_path / "another")
    expected, found = read_arrays(local), read_arrays(bucket)
    assert expected.keys() == found.keys()
    for name, values in expected.items():
        np.testing.assert_array_equal(values, found[name], err_msg=name)
    assert work.finished_task(bucket, 3) == DONE and work.finished_task(bucket, 4) is None
    assert not work.is_complete(bucket)
    work.complete(bucket, {"n": 1}, 2.0)
    assert work.is_complete(bucket) and work.summary(bucket, dict) == {"n": 1}
    assert not [name for name in place.sizes(bucket) if name.startswith("parts/")]
    assert work.last_complete(bucket.parent, bucket.name.partition("-")[0] or "x") in (None, bucket)
    work.discard(bucket)
    assert place.sizes(bucket) == {}


def test_place__a_file_is_there_whole_or_not_at_all(bucket):
    with pytest.raises(ZeroDivisionError), whole(bucket / "file") as partial:
        partial.write_bytes(b"half")
        raise ZeroDivisionError
    assert place.sizes(bucket) == {} and not list(cache.cache().folder.rglob("*.partial"))
    with pytest.raises(FileNotFoundError):
        place.here(bucket / "file")
    with whole(bucket / "file") as partial:
        partial.write_bytes(b"all of it")
        assert not place.is_file(bucket / "file")
    assert place.here(bucket / "file").read_bytes() == b"all of it" == objects.get(bucket / "file")[0]


def test_place__the_cache_stays_within_its_bound_and_what_went_is_fetched_again(bucket):
    kept = cache.cache()
    for i in range(30):
        arrays.store(bucket, f"a{i}", np.full(12_500, i))
        assert bytes_in(kept.folder) <= BOUND and kept.used_bytes <= BOUND
    for i in range(30):
        assert (arrays.read(bucket, f"a{i}") == i).all()
        assert bytes_in(kept.folder) <= BOUND
    assert bytes_in(kept.folder) > BOUND // 2  # it is used
    kept.bound = 90_000
    with pytest.raises(OSError, match="SPLATPRESS_CACHE_BYTES") as error:
        arrays.read(bucket, "a3")
    assert error.value.errno == errno.EFBIG


def test_place__a_scan_that_is_being_read_stays(bucket):
    objects.put(bucket / "scan.ply", bytes(600_000))
    scan = place.held(bucket / "scan.ply")
    for i in range(30):
        arrays.store(bucket, f"a{i}", np.zeros(12_500))
    assert scan.is_file() and bytes_in(cache.cache().folder) <= BOUND


def test_place__caches_of_processes_that_were_killed_go(tmp_path, monkeypatch):
    monkeypatch.setenv(cache.FOLDER, str(tmp_path))
    (tmp_path / "dead").mkdir()
    (tmp_path / "dead" / "alive").touch()
    (tmp_path / "dead" / "large").write_bytes(bytes(1000))
    first, second = cache._begun(), cache._begun()
    assert sorted(tmp_path.iterdir()) == sorted([first.folder, second.folder])


def test_place__one_holder_at_a_time_and_the_next_when_it_is_freed_or_silent(bucket, monkeypatch):
    first, second, third = (lease._Lease(bucket / "lock") for _ in range(3))
    assert first.take() and first.take() and not second.take()
    first.free()
    assert second.take() and not third.take()
    monkeypatch.setattr(lease, "LEASE_S", 0.0)
    assert third.take()  # by its clock the second has been silent for long enough
    assert not second._write(second._tag)  # which finds out when it writes again
    third.free()
    with place.alone(bucket / "lock"):
        pass


def test_place__of_many_that_ask_for_a_key_all_get_one(bucket, tmp_path):
    for path in (bucket / "key", tmp_path / "key"):
        made = iter([b"one", b"two", b"three"])
        assert {place.made_once(path, lambda made=made: next(made)) for _ in range(3)} == {b"one"}


def test_place__a_server_that_stumbles_at_every_other_request_changes_nothing(bucket, server, monkeypatch, tmp_path):
    monkeypatch.setattr(objects, "FIRST_WAIT_S", 0.001)
    with stumbling_proxy(server, every=2) as proxy:
        use(monkeypatch, proxy.port, tmp_path / "stumbling")
        work.write_json(bucket / "a.json", [1, 2])
        cache.cache().forget(bucket / "a.json")
        assert work.read_json(bucket / "a.json") == [1, 2]
        held = lease._Lease(bucket / "lock")
        assert held.take() and held._write(held._tag)
        held.free()
        root = zarr.open_array(store=place.zarr_store(bucket / "z"), mode="w", shape=(40,), chunks=(10,), dtype="i4")
        root[:] = np.arange(40)
        assert (zarr.open_array(store=place.zarr_store(bucket / "z"), mode="r")[:] == np.arange(40)).all()
        place.remove_folder(bucket)
        assert place.sizes(bucket) == {}
        assert min(proxy.busy, proxy.cut_before, proxy.cut_after) > 0


def test_place__stages_read_and_write_work_folders_by_storage_alone():
    """What asks the disk itself finds nothing where the folder is a bucket's."""
    sources = Path(place.__file__).parents[2].joinpath("pipeline", "stages").rglob("*.py")
    direct = re.compile(
        r"np\.load\(|\.read_bytes\(|\.read_text\(|\.glob\(|\.iterdir\(|folder[^\n]*\.(is_file|exists)\("
    )
    found = {path.name: direct.findall(path.read_text()) for path in sources}
    assert not {name: hits for name, hits in found.items() if hits}
