"""Volumes through the API: whole in one file, as the command line reads them; what points elsewhere is refused."""

from __future__ import annotations

import gzip
import io

import nibabel
import numpy as np
import pytest
import tifffile
from fastapi.testclient import TestClient

from services.api.app import create_app
from services.problems import Problem
from services.settings import settings_from
from services.uploads import validation, volumes
from services.uploads.scans import disk_name
from tests.pipeline.volumes.made import ball, nrrd_header, write_nrrd

LIMITS = {"max_photo_pixels": 10**6, "max_unpacked_bytes": 10**6, "max_archive_ratio": 100}
VOXELS = ball().astype(np.float32)  # 24 x 22 x 20
MHA = b"NDims = 3\nDimSize = 24 22 20\nElementType = MET_FLOAT\nElementDataFile = "
ELSEWHERE = "in another file; allowed: a volume that is whole in one file"


@pytest.fixture(scope="module")
def api(tmp_path_factory):
    app = create_app(settings_from({}, data=tmp_path_factory.mktemp("data"), reserve_bytes=0))
    with TestClient(app, base_url="http://127.0.0.1", raise_server_exceptions=False) as client:
        yield client


def _nifti(path):
    nibabel.Nifti1Image(VOXELS.T, np.diag([1, 2, 3, 1.0])).to_filename(path)


def _ome(uuids: tuple[str, ...], own: str = "urn:uuid:1") -> str:
    planes = "".join(
        f'<TiffData IFD="{i}" FirstZ="{i}" PlaneCount="1"><UUID FileName="../../{u[-1]}.tif">{u}</UUID></TiffData>'
        for i, u in enumerate(uuids)
    )
    return (
        f'<OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" UUID="{own}"><Image ID="Image:0"><Pixels '
        f'ID="Pixels:0" DimensionOrder="XYZCT" Type="float" SizeX="24" SizeY="22" SizeZ="{len(uuids)}" SizeC="1" '
        f'SizeT="1">{planes}</Pixels></Image></OME>'
    )


def _tiff(path, uuids: tuple[str, ...]):
    tifffile.imwrite(path, VOXELS[: len(uuids)], description=_ome(uuids), metadata=None, photometric="minisblack")


def answer(path, **limits) -> dict:
    return validation._answer(path, LIMITS | limits)


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("a.nrrd", lambda path: write_nrrd(path, VOXELS, "gzip")),
        ("a.nii", _nifti),
        ("A.NII.GZ", _nifti),
        ("a.mha", lambda path: path.write_bytes(MHA + b"LOCAL\n" + VOXELS.tobytes())),
        ("a.tif", lambda path: tifffile.imwrite(path, VOXELS)),
        ("own.ome.tiff", lambda path: _tiff(path, ("urn:uuid:1",) * 3)),
    ],
)
def test_volumes__what_the_command_line_reads_is_taken_under_the_name_that_a_job_finds(tmp_path, name, write):
    write(tmp_path / name)
    stored = (tmp_path / name).rename(tmp_path / disk_name(name))
    header = answer(stored)["header"]
    assert header["kind"] == "volume" and header["shape"][:2] == [24, 22] and header["cameras"]["count"] == 0
    assert np.all(np.array(header["bounds"]["max"]) > header["bounds"]["min"])


@pytest.mark.parametrize(
    "line", ["data file: ../../secret\n", "DataFile:=LIST\n/etc/passwd\n", "data file: there.raw\n"]
)
def test_volumes__a_header_that_names_another_file_is_refused_alike_whether_it_is_there(tmp_path, line):
    (tmp_path / "there.raw").write_bytes(VOXELS.tobytes())
    (tmp_path / "scan.nrrd").write_bytes(nrrd_header(VOXELS, extra=line))
    problem = answer(tmp_path / "scan.nrrd")["problem"]
    assert problem["status"] == 422 and problem["detail"] == f"scan.nrrd: a header whose voxels lie {ELSEWHERE}"


@pytest.mark.parametrize("value", [b"there.raw\n", b"../../secret\n", b"LIST\n/etc/passwd\n", b"a%d.raw 1 20 1\n"])
def test_volumes__a_metaimage_that_names_another_file_is_refused_before_it_is_opened(tmp_path, monkeypatch, value):
    (tmp_path / "scan.mha").write_bytes(MHA + value)
    monkeypatch.setattr("pipeline.volumes.open.open_volume", None)
    problem = answer(tmp_path / "scan.mha")["problem"]
    assert problem["status"] == 422 and problem["detail"] == f"scan.mha: a header whose voxels lie {ELSEWHERE}"


def test_volumes__metadata_that_name_another_file_are_refused_before_it_is_opened(tmp_path, monkeypatch):
    _tiff(tmp_path / "scan.tif", ("urn:uuid:1", "urn:uuid:2"))
    monkeypatch.setattr("pipeline.volumes.open.open_volume", None)
    problem = answer(tmp_path / "scan.tif")["problem"]
    assert problem["status"] == 422 and problem["detail"].endswith(ELSEWHERE)


def test_volumes__limits_are_of_slices_of_all_voxels_and_of_what_is_packed(tmp_path, monkeypatch):
    path = write_nrrd(tmp_path / "scan.nrrd", np.zeros((40, 40, 40), np.float32), "gzip")
    assert "header" in answer(path)  # any ratio while it is small
    assert "1,600 voxels a slice; allowed: at most 1,599" in answer(path, max_photo_pixels=1599)["problem"]["detail"]
    assert "256,000 bytes of voxels" in answer(path, max_unpacked_bytes=255_999)["problem"]["detail"]
    monkeypatch.setattr(volumes, "SMALL_BYTES", 1 << 10)
    assert "bytes of voxels for one of the file" in answer(path)["problem"]["detail"]
    path.write_bytes(nrrd_header(VOXELS, "gzip") + gzip.compress(b"too little"))
    assert answer(path)["problem"]["status"] == 422


def test_volumes__several_numbers_a_voxel_are_taken_and_said(tmp_path):
    several = np.stack([VOXELS, VOXELS], axis=-1)
    header = answer(write_nrrd(tmp_path / "scan.nrrd", several, extra="kinds: vector domain domain domain\n"))["header"]
    assert header["shape"] == [24, 22, 20] and "component" in header["warnings"][-1]


@pytest.mark.parametrize("name", ["a.nhdr", "a.hdr", "a.raw", "a.gz", "a.zarr"])
def test_volumes__what_needs_a_second_file_is_unsupported(name):
    with pytest.raises(Problem, match=r"allowed: .*\.nii\.gz") as caught:
        volumes.check_name(name)
    assert caught.value.status == 415


def test_volumes__the_document_of_one_says_what_it_is(api):
    stream = io.BytesIO(nrrd_header(VOXELS) + VOXELS.tobytes())
    scan = api.post("/v1/scans", files={"file": ("head.nrrd", stream.getvalue())}).json()
    assert (scan["kind"], scan["points"], scan["shape"]) == ("volume", None, [24, 22, 20])
    assert "iso values" in scan["calls_for"][0]
    made = api.post("/v1/jobs", json={"scan": scan["id"], "preset": "draft", "options": {"iso": "50"}})
    assert made.status_code == 201 and made.json()["settings"]["iso"].startswith("50.0=")
