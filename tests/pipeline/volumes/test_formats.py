"""NIfTI, TIFF, zarr and raw volumes: voxels, frames and units, and what is refused."""

from __future__ import annotations

import json

import nibabel
import numpy as np
import pytest
import tifffile
import zarr

from pipeline.volumes.formats.tiff import natural_key
from pipeline.volumes.open import is_volume, open_volume
from pipeline.volumes.volume import Choice
from storage.errors import InvalidScan, UnsupportedScan
from tests.pipeline.volumes.made import RAMP, read

# --- NIfTI ------------------------------------------------------------------------------------------------------------

RAS = np.array([[0.5, 0, 0, -3], [0, 0.5, 0, -4], [0, 0, 2, 5], [0, 0, 0, 1]], float)
LAS = RAS * [[-1], [1], [1], [1]]
OBLIQUE = np.array([[0.4, -0.3, 0, 1], [0.3, 0.4, 0.1, 2], [0, 0, 2, 3], [0, 0, 0, 1]], float)


@pytest.mark.parametrize("affine", [RAS, LAS, OBLIQUE], ids=["RAS", "LAS", "oblique"])
@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz"])
def test_nifti__positions_are_those_of_its_affine_transform(tmp_path, affine, name):
    image = nibabel.Nifti1Image(RAMP.T.copy(), affine)
    image.header.set_xyzt_units("mm")
    nibabel.save(image, tmp_path / name)
    volume = open_volume(tmp_path / name)
    assert np.array_equal(read(volume)[0], RAMP)
    assert np.allclose(np.array(volume.directions) @ (1, 2, 3) + volume.origin, (affine @ (1, 2, 3, 1))[:3])
    assert (volume.frame, volume.unit) == ("right-anterior-superior", "millimetre")


@pytest.mark.parametrize("order", ["<", ">"])
def test_nifti__slope_intercept_and_byte_order(tmp_path, order):
    header = nibabel.Nifti1Header(endianness=order)
    header.set_data_dtype(np.int16)
    image = nibabel.Nifti1Image(RAMP.T.copy(), RAS, header)
    image.header.set_slope_inter(2.0, -1024.0)
    nibabel.save(image, tmp_path / "a.nii")
    raw = bytearray((tmp_path / "a.nii").read_bytes())
    stored = nibabel.load(tmp_path / "a.nii")
    assert stored.dataobj.slope == 2.0 and raw
    voxels = read(open_volume(tmp_path / "a.nii"))[0]
    assert voxels.dtype == np.float32
    assert np.allclose(voxels, np.asarray(stored.dataobj).T)


def test_nifti__pairs_times_and_labels(tmp_path):
    nibabel.save(nibabel.Nifti1Pair(RAMP.T.copy(), RAS), tmp_path / "a.hdr")
    assert np.array_equal(read(open_volume(tmp_path / "a.hdr"))[0], RAMP)
    several = np.stack([RAMP.T, RAMP.T + 7], axis=3)
    nibabel.save(nibabel.Nifti1Image(several, RAS), tmp_path / "b.nii.gz")
    with pytest.raises(UnsupportedScan, match="--time 0..1"):
        open_volume(tmp_path / "b.nii.gz")
    assert np.array_equal(read(open_volume(tmp_path / "b.nii.gz", Choice(time=1)))[0], RAMP + 7)
    image = nibabel.Nifti1Image(RAMP.T.copy(), RAS)
    image.header.set_intent("label")
    nibabel.save(image, tmp_path / "c.nii")
    assert open_volume(tmp_path / "c.nii").is_labels


def test_nifti__colours_are_refused_by_name(tmp_path):
    rgb = np.zeros((4, 5, 6), np.dtype([("R", "u1"), ("G", "u1"), ("B", "u1")]))
    nibabel.save(nibabel.Nifti1Image(rgb, RAS), tmp_path / "a.nii")
    with pytest.raises(UnsupportedScan, match="colours"):
        open_volume(tmp_path / "a.nii")


def test_nifti__a_truncated_file_is_an_error(tmp_path):
    nibabel.save(nibabel.Nifti1Image(RAMP.T.copy(), RAS), tmp_path / "a.nii")
    whole = (tmp_path / "a.nii").read_bytes()
    for n in (0, 100, 347, 360, len(whole) - 1):
        (tmp_path / "b.nii").write_bytes(whole[:n])
        with pytest.raises(InvalidScan):
            read(open_volume(tmp_path / "b.nii"))


# --- TIFF -------------------------------------------------------------------------------------------------------------


def test_tiff__one_file_of_pages_with_the_spacing_of_imagej(tmp_path):
    tifffile.imwrite(
        tmp_path / "a.tif",
        RAMP.astype(np.uint16),
        imagej=True,
        resolution=(2.0, 2.0),
        metadata={"spacing": 1.5, "unit": "um", "axes": "ZYX"},
    )
    volume = open_volume(tmp_path / "a.tif")
    assert np.array_equal(read(volume)[0], RAMP.astype(np.uint16))
    assert np.allclose(volume.spacing, (0.5, 0.5, 1.5)) and volume.unit == "micrometre"


def test_tiff__one_file_of_pages_with_the_spacing_of_ome(tmp_path):
    metadata = {
        "axes": "ZYX",
        "PhysicalSizeX": 0.2,
        "PhysicalSizeY": 0.3,
        "PhysicalSizeZ": 0.9,
        "PhysicalSizeXUnit": "µm",
    }
    tifffile.imwrite(tmp_path / "a.ome.tif", RAMP, metadata=metadata, photometric="minisblack")
    volume = open_volume(tmp_path / "a.ome.tif")
    assert np.allclose(volume.spacing, (0.2, 0.3, 0.9)) and volume.unit == "micrometre"
    assert np.array_equal(read(volume)[0], RAMP)


def test_tiff__a_folder_in_natural_order(tmp_path):
    for k in range(12):
        tifffile.imwrite(tmp_path / f"slice{k}.tif", np.full((3, 4), k, np.uint8))
    volume = open_volume(tmp_path)
    assert volume.shape == (4, 3, 12) and any("spacing" in text for text in volume.warnings)
    assert read(volume)[0][:, 0, 0].tolist() == list(range(12))
    tifffile.imwrite(tmp_path / "slice12.tif", np.zeros((3, 5), np.uint8))
    with pytest.raises(InvalidScan, match="slice12.tif"):
        open_volume(tmp_path)
    assert sorted(["b2", "b10", "b1"], key=natural_key) == ["b1", "b2", "b10"]


def test_tiff__colours_are_refused_or_chosen_and_times_too(tmp_path):
    rgb = np.stack([RAMP, RAMP + 1, RAMP + 2], axis=3).astype(np.uint8)
    tifffile.imwrite(tmp_path / "a.tif", rgb, photometric="rgb")
    with pytest.raises(UnsupportedScan, match="--component 0..2"):
        open_volume(tmp_path / "a.tif")
    assert np.array_equal(read(open_volume(tmp_path / "a.tif", Choice(component=1)))[0], rgb[..., 1])
    several = np.stack([RAMP, RAMP + 5]).astype(np.uint8)
    tifffile.imwrite(tmp_path / "b.tif", several, imagej=True, photometric="minisblack", metadata={"axes": "TZYX"})
    assert np.array_equal(read(open_volume(tmp_path / "b.tif", Choice(time=1)))[0], several[1])


def test_tiff__a_broken_file_is_an_error(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", RAMP, compression="zlib", photometric="minisblack")
    whole = (tmp_path / "a.tif").read_bytes()
    for n in (3, 100, len(whole) // 2):
        (tmp_path / "b.tif").write_bytes(whole[:n])
        with pytest.raises((InvalidScan, UnsupportedScan)):
            read(open_volume(tmp_path / "b.tif"))


# --- zarr and raw -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", ["0.4", "0.5"])
def test_ome_zarr__scales_and_translations_of_the_finest_level(tmp_path, version):
    group = zarr.open_group(tmp_path / "a.zarr", mode="w", zarr_format=2 if version == "0.4" else 3)
    several = np.stack([RAMP, RAMP + 3])
    group.create_array("0", data=several, chunks=(1, 2, 5, 4))
    axes = [{"name": "c", "type": "channel"}] + [{"name": a, "type": "space", "unit": "micrometer"} for a in "zyx"]
    transforms = [
        {"type": "scale", "scale": [1, 2.0, 0.5, 0.25]},
        {"type": "translation", "translation": [0, 10, 20, 30]},
    ]
    scales = [{"axes": axes, "datasets": [{"path": "0", "coordinateTransformations": transforms}]}]
    group.attrs.update(
        {"multiscales": scales} if version == "0.4" else {"ome": {"version": "0.5", "multiscales": scales}}
    )
    with pytest.raises(UnsupportedScan, match="--component 0..1"):
        open_volume(tmp_path / "a.zarr")
    volume = open_volume(tmp_path / "a.zarr", Choice(component=1))
    assert np.array_equal(read(volume)[0], RAMP + 3)
    assert volume.spacing == (0.25, 0.5, 2.0) and volume.origin == (30.0, 20.0, 10.0) and volume.unit == "micrometre"


def test_zarr__a_plain_array_and_a_group_of_something_else(tmp_path):
    zarr.create_array(tmp_path / "a.zarr", data=RAMP, chunks=(4, 5, 4))
    assert is_volume(tmp_path / "a.zarr")
    assert np.array_equal(read(open_volume(tmp_path / "a.zarr"))[0], RAMP)
    zarr.open_group(tmp_path / "b.zarr", mode="w")
    with pytest.raises(UnsupportedScan, match="multiscales"):
        open_volume(tmp_path / "b.zarr")


def test_raw__is_what_its_sidecar_says(tmp_path):
    (tmp_path / "a.raw").write_bytes(b"head" + RAMP.astype(">i2").tobytes())
    told = {
        "sizes": [4, 5, 6],
        "type": "int16",
        "endian": "big",
        "spacing": [1, 1, 2],
        "origin": [5, 6, 7],
        "unit": "mm",
        "skip_bytes": 4,
    }
    with pytest.raises(InvalidScan, match="a.json"):
        open_volume(tmp_path / "a.raw")
    (tmp_path / "a.json").write_text(json.dumps(told))
    volume = open_volume(tmp_path / "a.raw")
    assert np.array_equal(read(volume)[0], RAMP)
    assert (volume.spacing, volume.origin, volume.unit) == ((1, 1, 2), (5, 6, 7), "millimetre")
    for wrong in ({"sizes": [4, 5]}, {"type": "bool"}, {"endian": "middle"}, {"sizes": [4, 5, 7]}):
        (tmp_path / "a.json").write_text(json.dumps(told | wrong))
        with pytest.raises(InvalidScan):
            open_volume(tmp_path / "a.raw")
