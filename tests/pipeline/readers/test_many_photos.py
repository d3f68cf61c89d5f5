"""Workspaces of many photographs: opening them takes steps in proportion to their number, told by counting calls."""

import sys
import zipfile

import pytest

from pipeline.readers import open_scan
from tests.pipeline.readers.workspace import write_workspace, zip_folder


def calls(path: str) -> int:
    """Functions of Python's that opening a scan and reading three of its photographs calls."""
    n = 0

    def count(frame, event, argument):
        nonlocal n
        n += event == "call"

    sys.setprofile(count)
    try:
        source = open_scan(path)
        for i in range(3):
            source.read_photo(i)
    finally:
        sys.setprofile(None)
    return n


@pytest.mark.parametrize("packed", [False, True])
def test_open_scan__of_twice_as_many_photographs_takes_twice_as_many_steps(tmp_path, packed):
    taken = []
    for n in (8, 20, 40, 80):  # the first pays for imports
        made = write_workspace(tmp_path / str(n), n_cameras=n, n_side=4, size_px=(8, 6)).path
        taken.append(calls(str(zip_folder(made, tmp_path / f"{n}.zip") if packed else made)))
    assert taken[3] - taken[2] < 2.4 * (taken[2] - taken[1])  # a quadratic step would bring it near 4


def test_open_scan__reads_the_list_of_an_archive_once(tmp_path, monkeypatch):
    read = []
    inside = zipfile.ZipFile._RealGetContents
    monkeypatch.setattr(zipfile.ZipFile, "_RealGetContents", lambda self: (read.append(1), inside(self))[1])
    path = zip_folder(write_workspace(tmp_path / "w", n_cameras=12, n_side=4, size_px=(8, 6)).path, tmp_path / "w.zip")
    read.clear()
    source = open_scan(str(path))
    [source.read_photo(i) for i in range(12)]
    assert sum(read) <= 2
