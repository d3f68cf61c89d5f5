"""COLMAP workspaces: the plane of workspace.py, whole and broken, and the two real photo scenes."""

import pickle
import re
import shutil
import struct
import zipfile

import numpy as np
import pycolmap
import pytest

from pipeline.readers import inspect_scan, open_scan
from storage.errors import InvalidScan, UnsupportedScan
from tests.pipeline.readers.shared_data import shared_scan
from tests.pipeline.readers.workspace import (
    FOCAL_PX,
    centre_of,
    render_photo,
    texture,
    write_photo,
    write_vis,
    write_workspace,
    zip_folder,
)

MODEL_FILES = ("cameras.bin", "images.bin", "rigs.bin", "frames.bin")


def gather(source, max_points=50):
    pieces = list(source.pieces(max_points))
    names = ("position", "normal", "color", "visible_count", "visible_camera")
    columns = {name: [getattr(p, name) for p in pieces] for name in names}
    return {name: None if c[0] is None else np.concatenate(c) for name, c in columns.items()}


def assert_same(a, b):
    assert a.cameras == b.cameras and a.n_points == b.n_points and a.has_visibility == b.has_visibility
    left, right = gather(a), gather(b)
    for name in left:
        np.testing.assert_array_equal(left[name], right[name], err_msg=name)
    for i in range(len(a.cameras)):
        np.testing.assert_array_equal(a.read_photo(i), b.read_photo(i))


def project(camera, points):
    """Plain pinhole projection, as pipeline.scan.Camera states it."""
    local = (points - np.array(camera.centre)) @ np.array(camera.rotation).T
    focal, centre = (camera.fx_px, camera.fy_px), (camera.cx_px, camera.cy_px)
    return local[:, :2] / local[:, 2:] * focal + centre


def sampled(photo, pixels):
    """Bilinear lookups where the centre of the first pixel is (0.5, 0.5)."""
    at = pixels - 0.5
    low = np.floor(at).astype(int)
    (fx, fy), (x, y) = (at - low).T[..., None], low.T
    top = photo[y, x] * (1 - fx) + photo[y, x + 1] * fx
    bottom = photo[y + 1, x] * (1 - fx) + photo[y + 1, x + 1] * fx
    return top * (1 - fy) + bottom * fy


# --- what a good workspace gives ---


def test_colmap__points_are_those_of_the_files(tmp_path):
    made = write_workspace(tmp_path / "w")
    source = open_scan(made.path)
    got = gather(source)
    np.testing.assert_array_equal(got["position"], made.position.astype(np.float64))
    np.testing.assert_array_equal(got["normal"], made.normal)
    np.testing.assert_array_equal(got["color"], made.color)
    assert got["visible_count"].tolist() == [len(v) for v in made.visible]
    assert got["visible_camera"].tolist() == [i for v in made.visible for i in v]
    assert source.has_normals and source.has_colors and source.has_visibility and not source.warnings


def test_colmap__cameras_project_the_points_onto_their_colours(tmp_path):
    made = write_workspace(tmp_path / "w")
    source = open_scan(made.path)
    for i, camera in enumerate(source.cameras):
        pixels = project(camera, made.position)
        inside = ((pixels > 1) & (pixels < [camera.width_px - 1, camera.height_px - 1])).all(axis=1)
        assert inside.sum() > 50
        np.testing.assert_allclose(sampled(source.read_photo(i), pixels[inside]), made.color[inside], atol=3)


@pytest.mark.parametrize("max_points", [1, 7, 144, 1000])
def test_colmap__piece_size_changes_nothing(tmp_path, max_points):
    source = open_scan(write_workspace(tmp_path / "w").path)
    whole, parts = gather(source, 10_000), gather(source, max_points)
    for name in whole:
        np.testing.assert_array_equal(whole[name], parts[name], err_msg=name)


def test_colmap__visibility_blocks_change_nothing(tmp_path, monkeypatch):
    source = open_scan(write_workspace(tmp_path / "w").path)
    whole = gather(source, 10)
    monkeypatch.setattr("pipeline.readers.colmap.visibility._BLOCK_BYTES", 8)
    for name, values in gather(source, 10).items():
        np.testing.assert_array_equal(values, whole[name], err_msg=name)


def test_colmap__binary_and_text_models_are_the_same(tmp_path):
    binary, text = (write_workspace(tmp_path / e, ending=e, image_ids=(30, 10, 20)) for e in (".bin", ".txt"))
    assert_same(open_scan(binary.path), open_scan(text.path))


@pytest.mark.parametrize("wrap", ["", "dense/"])
def test_colmap__a_zip_is_the_same_as_its_folder(tmp_path, wrap):
    made = write_workspace(tmp_path / "w")
    assert_same(open_scan(made.path), open_scan(zip_folder(made.path, tmp_path / "w.zip", wrap)))


def test_colmap__a_zip_leaves_nothing_behind(tmp_path, monkeypatch):
    made = write_workspace(tmp_path / "w")
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(scratch))
    source = open_scan(zip_folder(made.path, tmp_path / "w.zip"))
    gather(source), source.read_photo(0)
    assert not list(scratch.iterdir())


def test_colmap__finds_the_model_in_sparse_0(tmp_path):
    made = write_workspace(tmp_path / "w")
    before = open_scan(made.path).cameras
    (made.path / "sparse").rename(made.path / "old")
    (made.path / "old").rename(made.path / "new")
    (made.path / "sparse").mkdir()
    (made.path / "new").rename(made.path / "sparse" / "0")
    assert open_scan(made.path).cameras == before


@pytest.mark.parametrize("ending", [".bin", ".txt"])
def test_colmap__cameras_stand_in_the_order_of_registered_images_not_of_ids_or_names(tmp_path, ending):
    made = write_workspace(tmp_path / "w", ending=ending, image_ids=(30, 10, 20))
    assert made.names == ("0001.png", "0002.png", "0000.png")
    cameras = open_scan(made.path).cameras
    assert tuple(c.name for c in cameras) == made.names
    np.testing.assert_allclose(cameras[2].centre, centre_of(0, 3), atol=1e-12)


def test_colmap__models_without_rigs_and_frames_keep_the_order_of_the_file(tmp_path):
    made = write_workspace(tmp_path / "w", ending=".txt", image_ids=(30, 10, 20))
    sparse = made.path / "sparse"
    (sparse / "rigs.txt").unlink()
    (sparse / "frames.txt").unlink()
    lines = [line for line in (sparse / "images.txt").read_text().splitlines() if not line.startswith("#")]
    (sparse / "images.txt").write_text("\n".join(lines[4:6] + lines[0:2] + lines[2:4]) + "\n")
    assert [c.name for c in open_scan(made.path).cameras] == ["0002.png", "0000.png", "0001.png"]


def test_colmap__simple_pinhole_is_taken_as_it_is(tmp_path):
    made = write_workspace(tmp_path / "w", model="SIMPLE_PINHOLE", params=(50.0, 30.0, 25.0))
    source = open_scan(made.path)
    camera = source.cameras[0]
    assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == (50, 50, 30, 25)
    assert inspect_scan(made.path)["cameras"]["models"] == {"SIMPLE_PINHOLE": 3}


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_RADIAL", (FOCAL_PX, 32, 24, -0.15)),
        ("OPENCV", (FOCAL_PX, 62.0, 31, 25, -0.1, 0.02, 0.001, -0.002)),
        ("OPENCV_FISHEYE", (FOCAL_PX, FOCAL_PX, 32, 24, 0.01, 0, 0, 0)),
    ],
)
def test_colmap__distorted_photos_are_undistorted_to_the_camera_that_is_stated(tmp_path, model, params):
    made = write_workspace(tmp_path / "w", model=model, params=params)
    source = open_scan(made.path)
    for i, camera in enumerate(source.cameras):
        photo = source.read_photo(i)
        assert photo.shape == (camera.height_px, camera.width_px, 3)
        pinhole = [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px]
        size = {"width": camera.width_px, "height": camera.height_px}
        truth = render_photo(pycolmap.Camera(model="PINHOLE", params=pinhole, **size), np.array(camera.centre))
        error = np.abs(photo.astype(float) - truth)[3:-3, 3:-3]
        assert error.mean() < 1.5 and error.max() < 12


def test_colmap__missing_vis_leaves_visibility_open_with_a_warning(tmp_path):
    made = write_workspace(tmp_path / "w")
    (made.path / "fused.ply.vis").unlink()
    source = open_scan(made.path)
    assert not source.has_visibility and "depth test" in source.warnings[0]
    assert gather(source)["visible_count"] is None


def test_colmap__unregistered_photos_are_left_out(tmp_path):
    made = write_workspace(tmp_path / "w")
    write_photo(made.path / "images" / "stray.png", np.zeros((3, 3, 3), np.uint8))
    assert len(open_scan(made.path).cameras) == 3


def test_colmap__source_can_be_sent_to_another_process(tmp_path):
    made = write_workspace(tmp_path / "w", model="SIMPLE_RADIAL", params=(FOCAL_PX, 32, 24, -0.1))
    source = open_scan(zip_folder(made.path, tmp_path / "w.zip"))
    assert_same(source, pickle.loads(pickle.dumps(source)))


# --- visibility ---


def broken_vis(tmp_path, content):
    made = write_workspace(tmp_path / "w")
    whole = (made.path / "fused.ply.vis").read_bytes()
    (made.path / "fused.ply.vis").write_bytes(content(whole))
    return made.path


@pytest.mark.parametrize("change", [-1, 1])
def test_colmap__a_vis_of_another_length_is_not_used_and_said(tmp_path, change):
    path = broken_vis(tmp_path, lambda whole: struct.pack("<Q", 144 + change) + whole[8:])
    source = open_scan(path)
    assert not source.has_visibility and gather(source)["visible_count"] is None
    assert rf"fused.ply.vis:count: {144 + change} points; allowed: 144" in " ".join(source.warnings)
    assert "delete it" in " ".join(source.warnings)


def test_colmap__no_truncated_vis_is_used_in_silence(tmp_path):
    made = write_workspace(tmp_path / "w", n_side=3)
    whole = (made.path / "fused.ply.vis").read_bytes()
    for n in range(len(whole)):
        (made.path / "fused.ply.vis").write_bytes(whole[:n])
        try:
            source = open_scan(made.path)
            gather(source)
            assert not source.has_visibility and "fused.ply.vis" in " ".join(source.warnings)
        except InvalidScan as error:
            assert "fused.ply.vis" in str(error)


def test_colmap__names_byte_and_point_where_a_vis_ends(tmp_path):
    path = broken_vis(tmp_path, lambda whole: whole[:-4])
    end = (path / "fused.ply.vis").stat().st_size
    with pytest.raises(InvalidScan, match=f"ends at byte {end}, within the list of point 143"):
        gather(open_scan(path))


def test_colmap__refuses_bytes_after_the_last_list(tmp_path):
    path = broken_vis(tmp_path, lambda whole: whole + bytes(4))
    with pytest.raises(InvalidScan, match="after the last list"):
        gather(open_scan(path))


@pytest.mark.parametrize("max_points", [1, 50, 1000])
def test_colmap__refuses_a_camera_that_does_not_exist_naming_point_and_value(tmp_path, max_points):
    made = write_workspace(tmp_path / "w")
    visible = list(made.visible)
    visible[101] = (3, 0)
    write_vis(made.path / "fused.ply.vis", tuple(visible))
    with pytest.raises(InvalidScan, match=r"point 101: camera 3; allowed: 0 to 2"):
        gather(open_scan(made.path), max_points)


def test_colmap__refuses_more_cameras_for_a_point_than_there_are(tmp_path):
    path = broken_vis(tmp_path, lambda whole: whole[:8] + struct.pack("<I", 2**32 - 1) + whole[12:])
    with pytest.raises(InvalidScan, match="point 0: 4294967295 cameras; allowed: at most 3"):
        gather(open_scan(path))


# --- models ---


@pytest.mark.parametrize("name", MODEL_FILES)
def test_colmap__refuses_every_truncation_of_a_model_file(tmp_path, name):
    made = write_workspace(tmp_path / "w", n_cameras=2)
    file = made.path / "sparse" / name
    whole = file.read_bytes()
    cameras = open_scan(made.path).cameras
    for cut, found in (
        *((whole[:n], r"\d+ bytes wanted at byte") for n in [*range(0, len(whole), 5), len(whole) - 1]),
        (whole + b"\0", f"bytes after its end at byte {len(whole)}"),
    ):
        file.write_bytes(cut)
        if name in ("rigs.bin", "frames.bin"):  # images say where cameras stand
            source = open_scan(made.path)
            assert any(re.search(f"{name}: {found}.*are not used", w) for w in source.warnings)
            assert source.cameras == cameras
        else:
            with pytest.raises(InvalidScan, match=f"{name}: {found}"):
                open_scan(made.path)


def test_colmap__refuses_every_truncation_of_a_text_model_or_gives_fewer_photos(tmp_path):
    made = write_workspace(tmp_path / "w", n_cameras=2, ending=".txt")
    for file in sorted((made.path / "sparse").glob("*.txt")):
        whole = file.read_bytes()
        for n in range(0, len(whole), 11):
            file.write_bytes(whole[:n])
            try:
                assert len(open_scan(made.path).cameras) <= 2
            except InvalidScan:
                pass
        file.write_bytes(whole)


@pytest.mark.parametrize("part", ["cameras.bin", "images.bin"])
def test_colmap__refuses_a_model_without_cameras_or_images(tmp_path, part):
    made = write_workspace(tmp_path / "w")
    (made.path / "sparse" / part).unlink()
    with pytest.raises(InvalidScan, match="sparse"):
        open_scan(made.path)


def test_colmap__points3d_are_not_needed(tmp_path):
    made = write_workspace(tmp_path / "w")
    before = open_scan(made.path).cameras
    (made.path / "sparse" / "points3D.bin").unlink()
    assert open_scan(made.path).cameras == before


@pytest.mark.parametrize("missing", ["sparse", "fused.ply"])
@pytest.mark.parametrize("zipped", [False, True])
def test_colmap__names_what_a_workspace_lacks(tmp_path, missing, zipped):
    made = write_workspace(tmp_path / "w")
    target = made.path / missing
    shutil.rmtree(target) if target.is_dir() else target.unlink()
    path = zip_folder(made.path, tmp_path / "w.zip") if zipped else made.path
    if missing == "sparse":  # then it is a folder with one file of points
        assert open_scan(path).format == "ply"
        return
    with pytest.raises(InvalidScan, match=f"{missing}: (no COLMAP model|missing)"):
        open_scan(path)


def test_colmap__refuses_an_unknown_camera_model_number(tmp_path):
    made = write_workspace(tmp_path / "w")
    file = made.path / "sparse" / "cameras.bin"
    content = bytearray(file.read_bytes())
    content[12:16] = struct.pack("<i", 99)
    file.write_bytes(content)
    with pytest.raises(InvalidScan, match="camera 1: camera model 99"):
        open_scan(made.path)


def test_colmap__refuses_a_model_that_cannot_be_undistorted_by_name(tmp_path):
    made = write_workspace(tmp_path / "w", ending=".txt")
    (made.path / "sparse" / "cameras.txt").write_text("1 EQUIRECTANGULAR 64 48 64 48\n")
    with pytest.raises(UnsupportedScan, match="camera model EQUIRECTANGULAR"):
        open_scan(made.path)


@pytest.mark.parametrize("params", ["-60 60 32 24", "0 60 32 24", "nan 60 32 24", "60 60 inf 24"])
def test_colmap__refuses_a_camera_without_a_focal_length(tmp_path, params):
    made = write_workspace(tmp_path / "w", ending=".txt")
    (made.path / "sparse" / "cameras.txt").write_text(f"1 PINHOLE 64 48 {params}\n")
    with pytest.raises(InvalidScan, match="sparse"):
        open_scan(made.path)


@pytest.mark.parametrize("field", ["1 0 0 0 nan 0 3", "0 0 0 0 0 0 3"])
def test_colmap__refuses_a_pose_that_is_not_rigid(tmp_path, field):
    made = write_workspace(tmp_path / "w", n_cameras=1, ending=".txt")
    (made.path / "sparse" / "rigs.txt").unlink()
    (made.path / "sparse" / "frames.txt").unlink()
    (made.path / "sparse" / "images.txt").write_text(f"1 {field} 1 0000.png\n\n")
    with pytest.raises(InvalidScan, match="pose"):
        open_scan(made.path)


@pytest.mark.parametrize("name", ["../0000.png", "/etc/hostname", "a\\..\\..\\b.png", "c:/b.png"])
def test_colmap__refuses_a_photo_name_that_leaves_images(tmp_path, name):
    made = write_workspace(tmp_path / "w", ending=".txt")
    images = made.path / "sparse" / "images.txt"
    images.write_text(images.read_text().replace("0000.png", name))
    with pytest.raises(InvalidScan, match="leaves images/"):
        open_scan(made.path)


def test_colmap__refuses_a_model_without_registered_images(tmp_path):
    made = write_workspace(tmp_path / "w", ending=".txt")
    for name in ("images.txt", "rigs.txt", "frames.txt"):
        (made.path / "sparse" / name).write_text("")
    with pytest.raises(InvalidScan, match="0 registered images"):
        open_scan(made.path)


# --- photos ---


@pytest.mark.parametrize("zipped", [False, True])
def test_colmap__names_a_missing_photo_and_its_camera(tmp_path, zipped):
    made = write_workspace(tmp_path / "w")
    (made.path / "images" / "0001.png").unlink()
    path = zip_folder(made.path, tmp_path / "w.zip") if zipped else made.path
    source = open_scan(path)
    assert [c.name for c in source.cameras] == ["0000.png", "0002.png"]
    said = " ".join(source.warnings)
    assert "1 of 3 registered" in said and "0001.png: missing, though registered with camera 1 of 64x48" in said
    seen = gather(source)
    expected = [[{0: 0, 2: 1}[c] for c in cameras if c != 1] for cameras in made.visible]
    assert np.split(seen["visible_camera"], np.cumsum(seen["visible_count"])[:-1])[3].tolist() == expected[3] == [0, 1]
    assert seen["visible_count"].tolist() == [len(cameras) for cameras in expected]
    np.testing.assert_array_equal(source.read_photo(1), open_scan(made.path).read_photo(1))


def test_colmap__refuses_a_workspace_without_any_photograph(tmp_path):
    made = write_workspace(tmp_path / "w")
    shutil.rmtree(made.path / "images")
    with pytest.raises(InvalidScan, match=r"images/0000.png: missing.*none of the 3 registered photographs"):
        open_scan(made.path)


@pytest.mark.parametrize("zipped", [False, True])
def test_colmap__names_a_photo_of_another_size_than_its_camera(tmp_path, zipped):
    made = write_workspace(tmp_path / "w")
    write_photo(made.path / "images" / "0002.png", np.zeros((48, 63, 3), np.uint8))
    path = zip_folder(made.path, tmp_path / "w.zip") if zipped else made.path
    source = open_scan(path)
    assert [c.name for c in source.cameras] == ["0000.png", "0001.png"]
    assert "0002.png: a photo of 63x48 pixels, registered with camera 1 of 64x48" in " ".join(source.warnings)


def test_colmap__a_file_that_is_no_photo_is_left_out(tmp_path):
    made = write_workspace(tmp_path / "w")
    (made.path / "images" / "0002.png").write_bytes(b"<html>404</html>")
    assert "0002.png: an unreadable photo" in " ".join(open_scan(made.path).warnings)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_colmap__refuses_a_truncated_photo_when_it_is_read(tmp_path, suffix):
    made = write_workspace(tmp_path / "w", photo_suffix=suffix)
    source = open_scan(made.path)
    file = made.path / "images" / f"0001{suffix}"
    file.write_bytes(file.read_bytes()[:-200])
    with pytest.raises(InvalidScan, match=rf"0001{suffix}: a damaged photo"):
        source.read_photo(1)
    assert source.read_photo(0).shape == (48, 64, 3)


def test_colmap__a_long_photo_header_in_a_zip_is_read_whole(tmp_path, monkeypatch):
    monkeypatch.setattr("pipeline.readers.colmap.photos._HEAD_BYTES", 10)
    made = write_workspace(tmp_path / "w")
    assert len(open_scan(zip_folder(made.path, tmp_path / "w.zip")).cameras) == 3


def test_colmap__refuses_a_damaged_member_of_a_zip(tmp_path):
    made = write_workspace(tmp_path / "w")
    path = tmp_path / "w.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for file in made.path.rglob("*"):
            if file.is_file():
                archive.write(file, file.relative_to(made.path))
        offset = archive.getinfo("fused.ply").header_offset
    content = bytearray(path.read_bytes())
    content[offset + 600] ^= 1
    path.write_bytes(content)
    with pytest.raises(InvalidScan, match="fused.ply: damaged inside the archive"):
        gather(open_scan(path))


# --- real scenes ---


@pytest.mark.parametrize(
    ("name", "n_points", "n_cameras", "size", "mean_visible"),
    [("fountain_p11", 329_992, 11, (1536, 1024), 6.12), ("monstree", 329_999, 14, (1488, 1116), 5.92)],
)
def test_colmap__real_scenes_have_the_known_counts(name, n_points, n_cameras, size, mean_visible):
    source = open_scan(shared_scan(name))
    assert source.n_points == n_points and len(source.cameras) == n_cameras
    assert {(c.width_px, c.height_px) for c in source.cameras} == {size}
    counts = np.concatenate([p.visible_count for p in source.pieces(100_000)])
    assert len(counts) == n_points and counts.mean() == pytest.approx(mean_visible, abs=0.005)


@pytest.mark.parametrize("name", ["fountain_p11", "monstree"])
def test_colmap__real_points_land_inside_the_photos_that_see_them_with_their_colours(name):
    source = open_scan(shared_scan(name))
    got = gather(source, 100_000)
    owner = np.repeat(np.arange(source.n_points), got["visible_count"])
    for i in (0, len(source.cameras) - 1):
        camera, seen = source.cameras[i], owner[got["visible_camera"] == i][::50]
        pixels = project(camera, got["position"][seen])
        inside = ((pixels > 1) & (pixels < [camera.width_px - 1, camera.height_px - 1])).all(axis=1)
        assert len(seen) > 500 and inside.mean() > 0.99
        photo, colors = source.read_photo(i), got["color"][seen[inside]].astype(float)
        right = sampled(photo, pixels[inside])
        wrong = sampled(photo[::-1, ::-1], pixels[inside])
        assert np.corrcoef(right.ravel(), colors.ravel())[0, 1] > 0.9
        assert np.corrcoef(wrong.ravel(), colors.ravel())[0, 1] < 0.6


def test_workspace__texture_and_photo_agree():
    camera = pycolmap.Camera(model="PINHOLE", width=8, height=6, params=[60, 60, 4, 3])
    photo = render_photo(camera, np.array([0.3, 0.1, -3.0]))
    x, y = 0.3 + (2.5 - 4) / 60 * 3, 0.1 + (1.5 - 3) / 60 * 3
    np.testing.assert_array_equal(photo[1, 2], texture(np.array(x), np.array(y)))
