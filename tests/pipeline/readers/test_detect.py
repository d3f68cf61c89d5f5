"""Which reader is chosen, and what `inspect` tells."""

import json

import numpy as np
import pytest

from pipeline.readers import inspect_scan, open_scan
from storage.errors import UnsupportedScan
from tests.pipeline.readers.workspace import write_workspace, zip_folder


@pytest.mark.parametrize("name", ["scan.nrrd", "scan.dwg", "scan.obj", "scan", "scan.PLYX"])
def test_open_scan__refuses_other_formats_naming_the_suffix_and_what_is_handled(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(b"anything")
    with pytest.raises(UnsupportedScan, match=f"file of type '{path.suffix.lower()}'.*COLMAP.*\\.e57") as error:
        open_scan(path)
    assert error.value.exit_code == 5


def test_open_scan__says_which_volumes_it_does_not_handle(tmp_path):
    (tmp_path / "a.vti").write_bytes(b"<VTKFile")
    with pytest.raises(UnsupportedScan, match="write the volume as .nrrd or .nii"):
        open_scan(tmp_path / "a.vti")


def test_open_scan__a_missing_path_is_file_not_found(tmp_path):
    with pytest.raises(FileNotFoundError, match="nothing.ply"):
        open_scan(tmp_path / "nothing.ply")


def test_open_scan__suffixes_may_be_capitals(tmp_path):
    made = write_workspace(tmp_path / "w")
    (made.path / "fused.ply").rename(tmp_path / "A.PLY")
    assert open_scan(tmp_path / "A.PLY").n_points == 144


def test_inspect__is_plain_json_and_tells_the_facts(tmp_path):
    made = write_workspace(tmp_path / "w")
    got = inspect_scan(zip_folder(made.path, tmp_path / "w.zip"))
    assert json.loads(json.dumps(got, allow_nan=False)) == got
    assert (got["format"], got["points"], got["has_visibility"]) == ("colmap", 144, True)
    assert got["cameras"]["count"] == 3 and got["cameras"]["sizes"] == {"64x48": 3}


def test_inspect__reads_no_points(tmp_path):
    made = write_workspace(tmp_path / "w")
    content = bytearray((made.path / "fused.ply").read_bytes())
    content[-100:] = np.full(25, np.nan, "<f4").tobytes()
    (made.path / "fused.ply").write_bytes(content)
    assert inspect_scan(made.path)["points"] == 144
