"""DICOM series: slices by their positions, tilted gantries, gaps, times; what is refused is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pydicom
import pytest
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian, generate_uid

from pipeline.volumes.open import is_volume, open_volume
from pipeline.volumes.volume import Choice
from storage.errors import InvalidScan, SplatpressError, UnsupportedScan
from tests.pipeline.volumes.made import RAMP, read

UID = "1.2.3.4.5"


def write_slice(folder: Path, name: str, pixels: np.ndarray, position, **more) -> None:
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = pydicom.uid.CTImageStorage
    meta.MediaStorageSOPInstanceUID = generate_uid()
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    one = FileDataset(name, {}, file_meta=meta, preamble=bytes(128))
    one.SOPClassUID, one.SOPInstanceUID, one.SeriesInstanceUID = (
        meta.MediaStorageSOPClassUID,
        meta.MediaStorageSOPInstanceUID,
        UID,
    )
    one.Modality, (one.Rows, one.Columns) = "CT", pixels.shape[:2]
    one.PixelSpacing, one.ImageOrientationPatient = [0.5, 0.25], [1, 0, 0, 0, 1, 0]
    one.ImagePositionPatient = list(map(float, position))
    one.SamplesPerPixel, one.PhotometricInterpretation = 1, "MONOCHROME2"
    one.BitsAllocated = one.BitsStored = 16
    one.HighBit, one.PixelRepresentation = 15, 1
    one.PixelData = pixels.astype("<i2").tobytes()
    for tag, value in more.items():
        setattr(one, tag, value)
    folder.mkdir(exist_ok=True)
    one.save_as(folder / name, enforce_file_format=True)


def series(folder: Path, at=range(6), tilt: float = 0.0, **more) -> Path:
    """RAMP's slices, 2 mm apart from z = 7 on, in files whose names and numbers say another order."""
    for k in at:
        number = (5 * k + 3) % 6
        write_slice(folder, f"IM{number}", RAMP[k], (10, -20 + tilt * k, 7 + 2 * k), InstanceNumber=number + 1, **more)
    return folder


def test_dicom__slices_stand_by_position_with_the_series_frame(tmp_path):
    volume = open_volume(series(tmp_path / "ct"))
    voxels, warnings = read(volume)
    assert (volume.format, volume.unit, volume.frame) == ("dicom", "millimetre", "left-posterior-superior")
    assert np.array_equal(voxels, RAMP) and voxels.dtype == np.int16 and not warnings
    assert np.allclose(volume.directions, np.diag([0.25, 0.5, 2])) and volume.origin == (10, -20, 7)
    assert is_volume(tmp_path / "ct") and len(volume.files) == 6


def test_dicom__values_are_after_slope_and_intercept_of_each_slice(tmp_path):
    folder = series(tmp_path / "ct", range(3), RescaleSlope=2, RescaleIntercept=-1024)
    series(folder, range(3, 6), RescaleSlope=1, RescaleIntercept=0)
    voxels, _ = read(open_volume(folder))
    assert voxels.dtype == np.float32
    assert np.array_equal(voxels[:3], RAMP[:3] * 2.0 - 1024) and np.array_equal(voxels[3:], RAMP[3:])


def test_dicom__a_tilted_gantry_shears_the_volume_and_is_named(tmp_path):
    volume = open_volume(series(tmp_path / "ct", tilt=0.5))
    assert np.allclose(volume.directions, [[0.25, 0, 0], [0, 0.5, 0.5], [0, 0, 2]])
    assert any("14.04 degrees off a right angle, as of a tilted gantry" in text for text in volume.warnings)


def test_dicom__missing_slices_leave_voxels_that_are_not_finite_and_are_named(tmp_path):
    volume = open_volume(series(tmp_path / "ct", (0, 1, 4, 5)))
    voxels, _ = read(volume)
    assert volume.shape == (4, 5, 6) and np.isnan(voxels[2:4]).all()
    assert np.array_equal(voxels[[0, 1, 4, 5]], RAMP[[0, 1, 4, 5]])
    assert any("2 slices are missing after IM2, 6 mm on where others lie 2 apart" in text for text in volume.warnings)
    uneven = series(tmp_path / "uneven", range(5))
    write_slice(uneven, "IM9", RAMP[5], (10, -20, 17.3))
    assert any("mm off where even ones would" in text for text in open_volume(uneven).warnings)


def test_dicom__several_times_are_chosen_from_and_series_are_one(tmp_path):
    folder = tmp_path / "ct"
    for time in range(2):
        for k in range(6):
            write_slice(folder, f"{time}-{k}", RAMP[k] + 1000 * time, (0, 0, k), AcquisitionNumber=time + 1)
    with pytest.raises(UnsupportedScan, match="2 times; allowed: one number a voxel; .*--time 0..1"):
        open_volume(folder)
    assert np.array_equal(read(open_volume(folder, Choice(time=1)))[0], RAMP + 1000)
    write_slice(folder, "other", RAMP[0], (0, 0, 9), SeriesInstanceUID="1.2.3.9")
    with pytest.raises(UnsupportedScan, match=r"2 series .* put the files of one into a folder"):
        open_volume(folder, Choice(time=1))


@pytest.mark.parametrize(
    "change, error, words",
    [
        ({"NumberOfFrames": 3}, UnsupportedScan, "a file of 3 frames"),
        ({"PhotometricInterpretation": "PALETTE COLOR"}, UnsupportedScan, "PALETTE COLOR"),
        ({"ImagePositionPatient": None}, InvalidScan, "no ImagePositionPatient"),
        ({"Columns": 9}, InvalidScan, "shape"),
        ({"PixelData": b"12"}, InvalidScan, "its pixels cannot be read"),
        ({"ImageOrientationPatient": [0, 1, 0, 0, 0, 1]}, InvalidScan, "rows and columns"),
    ],
)
def test_dicom__what_cannot_be_read_is_named(tmp_path, change, error, words):
    folder = series(tmp_path / "ct", range(5))
    write_slice(folder, "last", RAMP[5], (10, -20, 17), **change)
    with pytest.raises(error, match=words) as raised:
        read(open_volume(folder))
    assert isinstance(raised.value, SplatpressError) and "last" in str(raised.value)


def test_dicom__files_without_pixels_are_left_out_and_said(tmp_path):
    folder = series(tmp_path / "ct")
    (folder / "broken").write_bytes(bytes(128) + b"DICM" + bytes(range(256)))
    (folder / "notes.txt").write_text("taken on a Sunday")
    volume = open_volume(folder)
    assert np.array_equal(read(volume)[0], RAMP)
    assert "2 files have no DICOM pixels and are left out: broken, notes.txt" in volume.warnings
