"""NRRD as people have it: attached and detached, skipped lines and bytes, byte orders, compressions, frames."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.volumes.open import is_volume, open_volume
from pipeline.volumes.volume import Choice
from storage.errors import InvalidScan, UnsupportedScan
from tests.pipeline.volumes.made import RAMP, nrrd_header, packed, read, write_nrrd


@pytest.mark.parametrize("encoding", ["raw", "gzip", "bzip2"])
@pytest.mark.parametrize("endian", ["little", "big"])
@pytest.mark.parametrize("dtype", ["int8", "int16", "int32", "float32"])
def test_nrrd__voxels_come_back_in_every_encoding_byte_order_and_type(tmp_path, encoding, endian, dtype):
    volume = open_volume(write_nrrd(tmp_path / "a.nrrd", RAMP.astype(dtype), encoding, endian=endian))
    voxels, warnings = read(volume)
    assert volume.shape == (4, 5, 6) and voxels.dtype == np.dtype(dtype) and not warnings
    assert np.array_equal(voxels, RAMP.astype(dtype))


def test_nrrd__numbers_as_text(tmp_path):
    (tmp_path / "a.nrrd").write_bytes(nrrd_header(RAMP, "ascii") + "\n".join(map(str, RAMP.ravel().tolist())).encode())
    assert np.array_equal(read(open_volume(tmp_path / "a.nrrd"))[0], RAMP)


@pytest.mark.parametrize("encoding", ["raw", "gzip", "bzip2"])
def test_nrrd__detached_data_after_skipped_lines_and_bytes(tmp_path, encoding):
    data = packed(b"xyz" + RAMP.tobytes(), encoding)
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "a.bin").write_bytes(b"first\nsecond\n" + data)
    extra = "line skip: 2\nbyte skip: 3\ndata file: deep/a.bin\n"
    (tmp_path / "a.nhdr").write_bytes(nrrd_header(RAMP, encoding, extra))
    volume = open_volume(tmp_path / "a.nhdr")
    assert np.array_equal(read(volume)[0], RAMP)
    assert [p.rsplit("/", 1)[1] for p in volume.files] == ["a.nhdr", "a.bin"]


def test_nrrd__bytes_skipped_from_the_end(tmp_path):
    (tmp_path / "a.bin").write_bytes(b"a header of unknown length" + RAMP.tobytes())
    (tmp_path / "a.nhdr").write_bytes(nrrd_header(RAMP, extra="byte skip: -1\ndatafile: a.bin\n"))
    assert np.array_equal(read(open_volume(tmp_path / "a.nhdr"))[0], RAMP)


@pytest.mark.parametrize("named", ["LIST\na.0\na.1\na.2", "a.%d 0 2 1"])
def test_nrrd__a_list_and_a_pattern_of_data_files(tmp_path, named):
    for part in range(3):
        (tmp_path / f"a.{part}").write_bytes(RAMP[2 * part : 2 * part + 2].tobytes())
    (tmp_path / "a.nhdr").write_bytes(nrrd_header(RAMP, extra=f"data file: {named}").rstrip(b"\n"))
    assert np.array_equal(read(open_volume(tmp_path / "a.nhdr"))[0], RAMP)


@pytest.mark.parametrize("encoding", ["raw", "gzip", "bzip2"])
def test_nrrd__data_longer_than_promised_is_a_warning_and_shorter_an_error(tmp_path, encoding):
    longer, shorter = RAMP.tobytes() + b"more", RAMP.tobytes()[:-4]
    (tmp_path / "a.nrrd").write_bytes(nrrd_header(RAMP, encoding) + packed(longer, encoding))
    volume = open_volume(tmp_path / "a.nrrd")
    voxels, warnings = read(volume)
    assert np.array_equal(voxels, RAMP)
    assert any("after the last voxel" in text for text in [*warnings, *volume.warnings])
    (tmp_path / "b.nrrd").write_bytes(nrrd_header(RAMP, encoding) + packed(shorter, encoding))
    with pytest.raises(InvalidScan, match="truncated"):
        read(open_volume(tmp_path / "b.nrrd"))


@pytest.mark.parametrize("encoding", ["gzip", "bzip2"])
def test_nrrd__every_cut_of_a_compressed_file_is_an_error_of_its_own(tmp_path, encoding):
    whole = nrrd_header(RAMP, encoding) + packed(RAMP.tobytes(), encoding)
    for n in [*range(20, len(whole) - 12, 7), *range(len(whole) - 12, len(whole))]:
        (tmp_path / "a.nrrd").write_bytes(whole[:n])
        with pytest.raises((InvalidScan, UnsupportedScan)):
            read(open_volume(tmp_path / "a.nrrd"))


def test_nrrd__a_wrong_checksum_is_an_error(tmp_path):
    whole = bytearray(nrrd_header(RAMP, "gzip") + packed(RAMP.tobytes(), "gzip"))
    whole[-6] ^= 1
    (tmp_path / "a.nrrd").write_bytes(whole)
    with pytest.raises(InvalidScan, match="checksum"):
        read(open_volume(tmp_path / "a.nrrd"))


def test_nrrd__directions_origin_space_and_unit(tmp_path):
    extra = (
        "space: LPS\nspace directions: (0,2,0) (-1,0,0) (0,0.3,0.5)\nspace origin: (10,-20,30)\n"
        'space units: "mm" "mm" "mm"\n'
    )
    volume = open_volume(write_nrrd(tmp_path / "a.nrrd", RAMP, extra=extra))
    assert volume.frame == "left-posterior-superior" and volume.unit == "millimetre"
    last = np.array(volume.origin) + np.array(volume.directions) @ (3, 4, 5)
    assert np.allclose(last, [10 - 4, -20 + 6 + 1.5, 30 + 2.5])
    assert any("right angle" in text for text in volume.warnings)


def test_nrrd__spacing_alone_and_none_at_all(tmp_path):
    volume = open_volume(write_nrrd(tmp_path / "a.nrrd", RAMP, extra='spacings: 0.5 0.5 3\nunits: "um" "um" "um"\n'))
    assert volume.spacing == (0.5, 0.5, 3.0) and volume.unit == "micrometre"
    assert any("spacing differs" in text for text in volume.warnings)
    volume = open_volume(write_nrrd(tmp_path / "b.nrrd", RAMP))
    assert volume.spacing == (1.0, 1.0, 1.0) and any("no spacing" in text for text in volume.warnings)
    volume = open_volume(tmp_path / "b.nrrd", Choice(spacing=(1.0, 2.0, 3.0)))
    assert volume.spacing == (1.0, 2.0, 3.0)


@pytest.mark.parametrize("at,kinds", [(0, "vector domain domain domain"), (3, "domain domain domain time")])
def test_nrrd__several_numbers_a_voxel_are_refused_by_name_or_chosen(tmp_path, at, kinds):
    several = np.stack([RAMP, RAMP + 1, RAMP + 2], axis=3 - at)
    write_nrrd(tmp_path / "a.nrrd", several, extra=f"kinds: {kinds}\n")
    argument = "--time" if at else "--component"
    with pytest.raises(UnsupportedScan, match=f"choose one with {argument} 0..2"):
        open_volume(tmp_path / "a.nrrd")
    choice = Choice(time=1) if at else Choice(component=1)
    assert np.array_equal(read(open_volume(tmp_path / "a.nrrd", choice))[0], RAMP + 1)
    with pytest.raises(InvalidScan, match="0 to 2"):
        open_volume(tmp_path / "a.nrrd", Choice(time=3, component=3))


def test_nrrd__large_whole_numbers_are_rounded_and_counted(tmp_path):
    voxels = np.full((2, 2, 2), 2**40 + 1, np.int64)
    found, warnings = read(open_volume(write_nrrd(tmp_path / "a.nrrd", voxels)))
    assert found.dtype == np.float32 and any("8 voxels" in text for text in warnings)


@pytest.mark.parametrize(
    "change,where",
    [
        ((b"type: int16", b"type: block"), "type"),
        ((b"sizes: 4 5 6", b"sizes: 4 5"), "sizes"),
        ((b"sizes: 4 5 6", b"sizes: 4 5 0"), "sizes"),
        ((b"sizes: 4 5 6", b"sizes: 4 30 1"), "2 voxels"),
        ((b"encoding: raw", b"encoding: hex"), "encoding"),
        ((b"endian: little\n", b""), "endian"),
        ((b"encoding: raw\n", b"encoding: raw\ndata file: nowhere.bin\n"), "nowhere.bin"),
        ((b"encoding: raw\n", b"encoding: raw\nspace directions: (1,0,0) (2,0,0) (0,0,1)\n"), "plane"),
        ((b"encoding: raw\n", b"encoding: raw\nspacings: 1 1 0\n"), "spacing"),
        ((b"encoding: raw\n", b"encoding: raw\nbyte skip: -2\n"), "byte skip"),
        ((b"NRRD0004", b"NRRD0009"), "header"),
        ((b"dimension: 3", b"dimension: three"), "header"),
    ],
)
def test_nrrd__a_wrong_header_names_its_field(tmp_path, change, where):
    path = write_nrrd(tmp_path / "a.nrrd", RAMP)
    path.write_bytes(path.read_bytes().replace(*change))
    with pytest.raises((InvalidScan, UnsupportedScan), match=where):
        open_volume(path)


def test_open__what_is_no_volume(tmp_path):
    assert not is_volume(tmp_path / "a.ply") and not is_volume(tmp_path)
    with pytest.raises(FileNotFoundError):
        open_volume(tmp_path / "a.nrrd")
    (tmp_path / "a.ply").write_bytes(b"ply")
    with pytest.raises(UnsupportedScan, match="NRRD"):
        open_volume(tmp_path / "a.ply")
