"""MetaImage: voxels, frames, files beside the header, and what is refused."""

from __future__ import annotations

import zlib

import numpy as np
import pytest

from pipeline.volumes.open import is_volume, open_volume
from pipeline.volumes.volume import Choice
from storage.errors import InvalidScan, UnsupportedScan
from tests.pipeline.volumes.made import RAMP, read

OBLIQUE = "TransformMatrix = 0 1 0 -1 0 0 0 0 1\nOffset = 10 20 30\nElementSpacing = 0.5 0.25 2\n"


def header(data: str, extra: str = OBLIQUE, type_: str = "MET_SHORT", sizes: str = "4 5 6", n: int = 3) -> bytes:
    head = f"ObjectType = Image\nNDims = {n}\nBinaryData = True\nDimSize = {sizes}\nElementType = {type_}\n"
    return f"{head}{extra}ElementDataFile = {data}\n".encode()


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("msb", [False, True])
def test_metaimage__voxels_after_the_header_and_their_positions(tmp_path, packed, msb):
    data = RAMP.astype(">i2" if msb else "<i2").tobytes()
    extra = f"{OBLIQUE}BinaryDataByteOrderMSB = {msb}\nCompressedData = {packed}\n"
    (tmp_path / "a.mha").write_bytes(header("LOCAL", extra) + (zlib.compress(data) if packed else data))
    assert is_volume(tmp_path / "a.mha")
    volume = open_volume(tmp_path / "a.mha")
    voxels, warnings = read(volume)
    assert np.array_equal(voxels, RAMP) and not warnings
    # The first axis runs along y of the frame, the second along -x.
    assert np.allclose(np.array(volume.directions) @ (1, 2, 3) + volume.origin, (10 - 0.5, 20 + 0.5, 30 + 6))
    assert (volume.frame, volume.unit) == ("left-posterior-superior", "millimetre")


@pytest.mark.parametrize("how", ["one", "list", "pattern", "behind"])
def test_metaimage__voxels_in_files_beside_the_header(tmp_path, how):
    for k, slice_ in enumerate(RAMP):
        (tmp_path / f"s{k:02d}.raw").write_bytes(slice_.tobytes())
    (tmp_path / "all.raw").write_bytes(b"a header" * (how == "behind") + RAMP.tobytes())
    listed = "\n".join(f"s{k:02d}.raw" for k in range(6))
    data = {"one": "all.raw", "list": f"LIST\n{listed}", "pattern": "s%02d.raw 0 5 1", "behind": "all.raw"}[how]
    (tmp_path / "a.mhd").write_bytes(header(data, OBLIQUE + "HeaderSize = -1\n" * (how == "behind")))
    volume = open_volume(tmp_path / "a.mhd")
    assert np.array_equal(read(volume)[0], RAMP) and len(volume.files) == (7 if how in ("list", "pattern") else 2)


def test_metaimage__channels_and_times_are_chosen(tmp_path):
    several = np.stack([RAMP, RAMP + 9], axis=-1)  # channels stand side by side
    (tmp_path / "c.mha").write_bytes(header("LOCAL", "ElementNumberOfChannels = 2\n") + several.tobytes())
    with pytest.raises(UnsupportedScan, match="--component 0..1"):
        open_volume(tmp_path / "c.mha")
    volume = open_volume(tmp_path / "c.mha", Choice(component=1))
    assert np.array_equal(read(volume)[0], RAMP + 9) and any("no spacing" in note for note in volume.warnings)
    (tmp_path / "t.mha").write_bytes(header("LOCAL", "", sizes="4 5 6 2", n=4) + np.stack([RAMP, RAMP + 7]).tobytes())
    assert np.array_equal(read(open_volume(tmp_path / "t.mha", Choice(time=1)))[0], RAMP + 7)


@pytest.mark.parametrize(
    "content, error, found",
    [
        (header("LOCAL") + RAMP.tobytes()[:-1], InvalidScan, "239 bytes of voxels"),
        (header("gone.raw"), InvalidScan, "gone.raw is not there"),
        (header("LOCAL", type_="MET_STRING"), UnsupportedScan, "MET_STRING"),
        (header("LOCAL", sizes="4 5"), InvalidScan, "DimSize"),
        (header("LOCAL", sizes="4 5 x"), InvalidScan, "DimSize"),
        (header("LOCAL", n=2), UnsupportedScan, "2 dimensions"),
        (header("LOCAL", "TransformMatrix = 1 0 0 1 0 0 0 0 1\n") + RAMP.tobytes(), InvalidScan, "in one plane"),
        (header("%99999999999d.raw 0 5 1"), InvalidScan, "at most 65,536 files"),
        (header("s%d.raw 0 99999999999 1"), InvalidScan, "at most 65,536 files"),
        (header("s%s.raw 0 5 0"), InvalidScan, "at most 65,536 files"),
        (b"\0\1" * 400, InvalidScan, "before ElementDataFile"),
        (b"", InvalidScan, "before ElementDataFile"),
    ],
)
def test_metaimage__what_is_broken_is_named(tmp_path, content, error, found):
    (tmp_path / "a.mha").write_bytes(content)
    with pytest.raises(error, match=found):
        open_volume(tmp_path / "a.mha")


def test_metaimage__compressed_voxels_that_end_early_are_named(tmp_path):
    packed = zlib.compress(RAMP.tobytes())
    for rest in (packed[: len(packed) // 2], b"", b"no zlib at all"):
        (tmp_path / "a.mha").write_bytes(header("LOCAL", "CompressedData = True\n") + rest)
        with pytest.raises(InvalidScan, match="early|does not decompress"):
            read(open_volume(tmp_path / "a.mha"))
