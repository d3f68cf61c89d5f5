"""A slice of a scan is what its pieces have there, whatever stands before it; what is broken is named as in pieces."""

from __future__ import annotations

import pickle
import struct

import laspy
import numpy as np
import pytest

from pipeline.readers import open_scan
from pipeline.readers.colmap import visibility_index
from pipeline.readers.e57 import packets as e57_packets
from pipeline.scan import Piece, ScanSource
from storage.errors import InvalidScan
from tests.pipeline.readers import test_e57, test_las, test_ply
from tests.pipeline.readers.shared_data import shared_scan
from tests.pipeline.readers.workspace import write_vis, write_workspace, zip_folder

COLUMNS = ("position", "normal", "color", "colorless", "intensity", "visible_count", "visible_camera", "station")
SHARED = (
    "fountain_p11",
    "pump_e57/pumpAVisualReferenceImage.e57",
    "fountain_3stations/fountain_3stations.e57",
    "conference_room/conference_room.laz",
    "autzen_rgb_statefeet/autzen_trim.las",
    "organised_table_scene/scan.ply",
)


def joined(pieces: list[Piece]) -> dict[str, np.ndarray]:
    rows = {name: [getattr(piece, name) for piece in pieces] for name in COLUMNS}
    return {name: np.concatenate(found) for name, found in rows.items() if found and found[0] is not None}


def assert_slices(source: ScanSource, max_points: int, slices: list[tuple[int, int]]) -> None:
    source = pickle.loads(pickle.dumps(source))
    every = joined(list(source.pieces(max_points)))
    count = every.pop("visible_count", None)
    camera = every.pop("visible_camera", None)
    for first, stop in slices:
        pieces = list(source.read_slice(first, stop, max_points))
        assert max(len(piece.position) for piece in pieces) <= max_points
        found = joined(pieces)
        if count is not None:
            np.testing.assert_array_equal(found.pop("visible_count"), count[first:stop])
            np.testing.assert_array_equal(found.pop("visible_camera"), camera[count[:first].sum() : count[:stop].sum()])
        assert found.keys() == every.keys()
        for name, rows in found.items():
            np.testing.assert_array_equal(rows, every[name][first:stop], err_msg=name)


def slices_of(n: int) -> list[tuple[int, int]]:
    return [(0, n), (0, 1), (n - 1, n), (n // 3, n // 3 + 7), (n // 2, n)]


def laz_of_chunks(path, n: int, rows: int):
    """A LAZ file of chunks of `rows` points."""
    source = laspy.read(str(test_las.write(path.with_suffix(".las"), n=n, color=np.full((3, n), 4000))[0]))
    source.header.are_points_compressed = True
    with (
        open(path, "wb") as stream,
        laspy.LasWriter(stream, source.header, laz_backend=laspy.LazBackend.Lazrs) as writer,
    ):
        for at in range(0, n, rows):
            writer.write_points(source.points[at : at + rows])
    return path


def stations():
    rng = np.random.default_rng(0)

    def scan(n: int, names, **others):
        columns = {name: rng.normal(size=n) for name in names}
        columns |= {name: rng.integers(0, 65536, n) for name in test_e57.COLOR}
        return columns | {"intensity": rng.uniform(0, 1, n)} | others

    limits = {
        f"color{c}{end}": value for c in ("Red", "Green", "Blue") for end, value in (("Minimum", 0), ("Maximum", 65535))
    }
    pose = test_e57.pose_of(test_e57.TURNED, (1.0, 2.0, 3.0))
    return [
        scan(5000, test_e57.CARTESIAN, colorLimits=limits),
        scan(3, test_e57.SPHERICAL, pose=pose, colorLimits=limits),
        scan(20_000, test_e57.SPHERICAL, pose=pose, colorLimits=limits),
    ]


def made(kind: str, folder):
    if kind == "ply":
        return test_ply.write(folder / "a.ply", test_ply.table(1000))
    if kind == "big-endian ply":
        return test_ply.write(folder / "a.ply", test_ply.table(1000), "binary_big_endian")
    if kind == "las":
        return test_las.write(folder / "a.las", n=1000, color=np.full((3, 1000), 4000))[0]
    if kind == "laz":
        return laz_of_chunks(folder / "a.laz", 120_000, 120_000)
    if kind == "e57":
        return test_e57.write(folder / "a.e57", *stations())
    return write_workspace(folder / "workspace").path


@pytest.mark.parametrize("kind", ["ply", "big-endian ply", "las", "laz", "e57", "colmap"])
@pytest.mark.parametrize("max_points", [64, 100_000])
def test_slices__are_what_pieces_have_there(kind, max_points, tmp_path, monkeypatch):
    monkeypatch.setattr(visibility_index, "STEP", 10)
    source = open_scan(made(kind, tmp_path))
    assert_slices(source, max_points, slices_of(source.n_points))


@pytest.mark.parametrize("name", SHARED)
def test_slices__of_real_scans(name):
    source = open_scan(shared_scan(name))
    assert_slices(source, 1 << 16, slices_of(source.n_points))


def test_slices__of_laz_are_cheapest_at_its_chunks(tmp_path):
    assert open_scan(made("laz", tmp_path)).slice_rows == 50_000
    assert open_scan(made("las", tmp_path)).slice_rows == 1


def test_slices__there_are_none_of_what_is_read_from_its_start_only(tmp_path):
    assert open_scan(test_ply.write(tmp_path / "a.ply", test_ply.table(10), "ascii")).read_slice is None
    workspace = write_workspace(tmp_path / "workspace").path
    assert open_scan(zip_folder(workspace, tmp_path / "w.zip")).read_slice is None
    assert open_scan(workspace).read_slice is not None


def test_slices__a_damaged_page_of_an_e57_is_named(tmp_path):
    path = made("e57", tmp_path)
    source, data = open_scan(path), bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)
    with pytest.raises(InvalidScan, match=f"a wrong checksum of page {len(data) // 2 // 1024}"):
        list(source.read_slice(0, source.n_points, 1000))


@pytest.mark.parametrize("keep", [0, 40, 2000, 30_000])
def test_slices__a_cut_e57_is_refused(keep, tmp_path):
    path = made("e57", tmp_path)
    source = open_scan(path)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(InvalidScan):
        list(source.read_slice(0, source.n_points, 1000))


@pytest.mark.parametrize("at", range(0, 1024, 8))
def test_slices__a_hostile_e57_is_refused_or_gives_what_pieces_give(at, tmp_path):
    """Any eight bytes of the first page of a scan's section, with a checksum that holds."""
    import google_crc32c

    path = made("e57", tmp_path)
    source, data = open_scan(path), bytearray(path.read_bytes())
    page = int(e57_packets.packets_of(str(path), (7, 7, 7))[0].begin[0]) // 1020 * 1024
    data[page + at : page + at + 8] = b"\xff" * 8 if at % 16 else b"\0" * 8
    data[page + 1020 : page + 1024] = google_crc32c.value(bytes(data[page : page + 1020])).to_bytes(4, "big")
    path.write_bytes(data)
    try:
        sum(len(piece.position) for piece in source.read_slice(0, source.n_points, 10_000))
    except InvalidScan:
        pass


def test_slices__a_list_of_too_many_cameras_is_named_as_in_pieces(tmp_path, monkeypatch):
    monkeypatch.setattr(visibility_index, "STEP", 10)
    workspace = write_workspace(tmp_path / "workspace")
    path = workspace.path / "fused.ply.vis"
    data = bytearray(path.read_bytes())
    at = 8 + 4 * sum(1 + len(seen) for seen in workspace.visible[:77])
    data[at : at + 4] = struct.pack("<I", 1 << 30)
    path.write_bytes(data)
    source = open_scan(workspace.path)
    assert len(list(source.read_slice(0, 70, 30))) == 3
    for read in (
        lambda: source.pieces(30),
        lambda: source.read_slice(60, 80, 30),
        lambda: source.read_slice(100, 110, 30),
    ):
        with pytest.raises(InvalidScan, match="point 77: found 1073741824 cameras|point 77: 1073741824 cameras"):
            list(read())


def test_slices__bytes_after_the_last_list_are_refused_by_the_last_slice(tmp_path):
    workspace = write_workspace(tmp_path / "workspace")
    write_vis(workspace.path / "fused.ply.vis", workspace.visible)
    with open(workspace.path / "fused.ply.vis", "ab") as stream:
        stream.write(b"\0\0\0\0")
    source = open_scan(workspace.path)
    assert list(source.read_slice(0, source.n_points - 1, 1000))
    with pytest.raises(InvalidScan, match="bytes after the last list"):
        list(source.read_slice(source.n_points - 1, source.n_points, 1000))
