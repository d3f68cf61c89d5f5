"""`transforms.json`: the same cameras as the COLMAP model that it was made from, and its own words for what is
wrong."""

import json
import shutil

import numpy as np
import pytest

from pipeline.readers import open_scan
from storage.errors import InvalidScan, UnsupportedScan
from tests.pipeline.readers.workspace import write_workspace, zip_folder


@pytest.fixture
def made(tmp_path):
    """A workspace as nerfstudio has it, and the cameras of its COLMAP model."""
    path = write_workspace(tmp_path / "w").path
    cameras = open_scan(path).cameras
    frames = []
    for c in cameras:
        matrix = np.eye(4)
        matrix[:3, :3] = np.array(c.rotation).T @ np.diag([1, -1, -1])
        matrix[:3, 3] = c.centre
        frames.append({"file_path": f"images/{c.name}", "transform_matrix": matrix.tolist()})
    data = {"camera_model": "OPENCV", "fl_x": 60.0, "fl_y": 60.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48}
    (path / "fused.ply").rename(path / "sparse_pc.ply")
    (path / "fused.ply.vis").unlink()
    shutil.rmtree(path / "sparse")
    write(path, data | {"frames": frames, "ply_file_path": "sparse_pc.ply"})
    return path, cameras


def write(path, data):
    (path / "transforms.json").write_text(json.dumps(data))


def read(path):
    return json.loads((path / "transforms.json").read_text())


@pytest.mark.parametrize("packed", [False, True])
def test_transforms__has_the_cameras_of_the_model_it_was_made_from(made, tmp_path, packed):
    path, cameras = made
    source = open_scan(zip_folder(path, tmp_path / "a.zip", wrap="deep/er/") if packed else path)
    assert len(source.cameras) == len(cameras) and source.n_points == 144
    for got, expected in zip(source.cameras, cameras, strict=True):
        np.testing.assert_allclose(got.rotation, expected.rotation, atol=1e-12)
        np.testing.assert_allclose(got.centre, expected.centre, atol=1e-12)
        assert (got.fx_px, got.cy_px, got.width_px) == (expected.fx_px, expected.cy_px, expected.width_px)
    assert source.read_photo(2).shape == (48, 64, 3)


def test_transforms__of_rendered_scenes_leave_out_sizes_and_suffixes(made):
    path, cameras = made
    data = read(path)
    frames = [f | {"file_path": "./" + f["file_path"].removesuffix(".png")} for f in data["frames"]]
    write(path, {"camera_angle_x": 2 * np.arctan(32 / 60), "frames": frames})
    source = open_scan(path)
    got, expected = source.cameras[1], cameras[1]
    assert (got.width_px, got.height_px, got.cy_px) == (64, 48, 24) and got.fx_px == pytest.approx(60)
    assert source.read_photo(1).shape == (48, 64, 3) and len(source.cameras) == len(cameras)
    np.testing.assert_allclose(got.centre, expected.centre, atol=1e-12)


def test_transforms__a_frame_may_have_a_lens_of_its_own(made):
    path, _ = made
    data = read(path)
    data["frames"][1] |= {"k1": 0.05, "fl_x": 61.0}
    write(path, data)
    source = open_scan(path)
    assert source.details["camera_models"] == {"PINHOLE": 2, "OPENCV": 1}


@pytest.mark.parametrize(
    ("change", "error", "said"),
    [
        (lambda d: d | {"camera_model": "EQUIRECTANGULAR"}, UnsupportedScan, "EQUIRECTANGULAR"),
        (lambda d: {k: v for k, v in d.items() if k != "fl_x"}, InvalidScan, r"frames\[0\].fl_x: None"),
        (lambda d: d | {"frames": []}, InvalidScan, "frames: missing or empty"),
        (lambda d: d | {"frames": [d["frames"][0] | {"transform_matrix": [[1, 2]]}]}, InvalidScan, "no 4 x 4 matrix"),
        (
            lambda d: d | {"frames": [d["frames"][0] | {"transform_matrix": (2 * np.eye(4)).tolist()}]},
            InvalidScan,
            "rotation",
        ),
        (lambda d: d | {"w": -3}, InvalidScan, "-3x48"),
    ],
)
def test_transforms__what_is_wrong_is_named_by_frame_and_value(made, change, error, said):
    path, _ = made
    write(path, change(read(path)))
    with pytest.raises(error, match=said):
        open_scan(path)
