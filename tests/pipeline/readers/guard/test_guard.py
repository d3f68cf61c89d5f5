"""What parses strangers' bytes may die, hang or want too much, and costs one line."""

import os
import time

import numpy as np
import pytest

from pipeline.readers.guard import guard
from storage.errors import InvalidScan, ResourceExhausted


@pytest.fixture
def path(tmp_path):
    (tmp_path / "a.laz").write_bytes(b"LASF")
    return str(tmp_path / "a.laz")


def test_guard__a_call_returns_what_it_would_here(path):
    assert guard.call(path, sorted, [3, 1, 2]) == [1, 2, 3]
    array = guard.call(path, np.arange, 5)
    array[0] = 7  # arrays that come back can be written to
    assert array.tolist() == [7, 1, 2, 3, 4]
    assert guard.call(path, np.zeros, 0).shape == (0,)


def test_guard__an_error_is_raised_here(path):
    with pytest.raises(ZeroDivisionError):
        guard.call(path, divmod, 1, 0)
    with pytest.raises(InvalidScan, match="somewhere: this; allowed: that"):
        guard.call(path, _refuse)


def _refuse():
    raise InvalidScan("somewhere", "this", "that")


@pytest.mark.parametrize(
    ("function", "arguments", "said"), [(os.abort, (), "SIGABRT"), (os._exit, (3,), "exit status 3")]
)
def test_guard__a_process_that_dies_is_an_invalid_scan_and_the_next_call_works(path, function, arguments, said):
    with pytest.raises(InvalidScan, match=f"a.laz: crashes its reader .{said}"):
        guard.call(path, function, *arguments)
    assert guard.call(path, abs, -1) == 1


def test_guard__a_call_that_does_not_end_is_ended(path, monkeypatch):
    monkeypatch.setattr(guard, "SECONDS", 0.3)
    begun = time.process_time()
    with pytest.raises(InvalidScan, match="takes more than 0 s of processor time"):
        guard.call(path, sum, range(1 << 60))
    assert time.process_time() - begun < 1


def test_guard__waiting_takes_no_processor_time_and_is_not_ended(path, monkeypatch):
    monkeypatch.setattr(guard, "SECONDS", 0.3)
    guard.call(path, time.sleep, 0.6)


def test_guard__memory_beyond_the_limit_is_a_resource_error(path):
    with pytest.raises(ResourceExhausted, match="needs more than 1,024 MiB"):
        guard.call(path, bytearray, 1 << 33)


def test_guard__generators_stream_side_by_side(path):
    def slow(n):
        return guard.iterate(path, _counted, n)

    assert list(zip(slow(3), slow(3), strict=True)) == [(0, 0), (1, 1), (2, 2)]
    unfinished = slow(1 << 40)
    assert [next(unfinished) for _ in range(4)] == [0, 1, 2, 3]
    unfinished.close()
    assert guard.call(path, abs, -2) == 2


def _counted(n):
    yield from range(n)
