"""Small files of the kinds that people report, each with what its maker knows: positions, colours, normals, counts,
words."""

import tarfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from pipeline.readers import inspect_scan, open_scan
from pipeline.readers.attributes.counts import over_all_points
from pipeline.readers.check import check_scan
from storage.errors import InvalidScan

CASES = Path(__file__).resolve().parents[4] / "shared" / "cases"

# What `check` and `inspect` say of each beforehand, and how many points are drawn of how many.
SAID = {
    "e57_phantom_third.e57": "504 of 1,512 points lie at their scanner's own origin",
    "e57_normals.e57": "",
    "e57_merged_object.e57": "",
    "e57_empty_station.e57": "stations ['empty'] have no points",
    "e57_float_colors.e57": "taken as 0 to 1",
    "las_withheld.las": "40 of 1,048 points are marked as withheld",
    "las_rgb_to_256.las": "taken as 8-bit values",
    "las_12bit.las": "taken as 12-bit values",
    "las_intensity_constant.las": "its intensity is constant (255)",
    "las_late_colors.laz": "",
    "las_metre_and_feet.las": "heights are in US survey foot and its other coordinates in metre",
    "ply_pdal_normalx.ply": "",
    "ply_rgb_names.ply": "",
    "ply_cr_lines.ply": "",
    "ply_openmvs_lists.ply": "view_indices",
    "ply_utm_float.ply": "they differ by 0.5 at least",
    "ws_latin1_names": "",
    "ws_single_lines": "no second line of image points",
    "ws_models_no_vis": "sparse/1 (4 photographs",
    "ws_cropped": "delete it",
    "ws_case": "'IMG_0.jpg' is 'images/IMG_0.JPG'",
    "zip_dsstore.zip": "",
    "zip_dsstore_thumbs.zip": "",
    "zip_nested.zip": "",
    "zip_mac_umlaut.zip": "",
}
OF_POINTS = {"e57_phantom_third.e57", "las_withheld.las", "ply_utm_float.ply"}  # told by all points, not by the header


@dataclass(frozen=True)
class Drawn:
    position: np.ndarray
    color: np.ndarray | None
    normal: np.ndarray | None


def case(name: str, tmp_path: Path) -> Path:
    path = CASES / "inputs" / name
    if (packed := path.with_name(f"{name}.tar")).exists():
        with tarfile.open(packed, encoding="utf-8", errors="surrogateescape") as archive:
            archive.extractall(tmp_path, filter="data")
        return tmp_path / name
    if not path.exists():
        pytest.skip(f"{path} is not there; see shared/cases/README.md of the project")
    return path


def drawn(source) -> Drawn:
    """The points that are not left out."""
    pieces = list(source.pieces(500))
    keep = [np.ones(len(p.position), bool) if p.mark is None else p.mark == 0 for p in pieces]

    def column(name):
        rows = [getattr(p, name) for p in pieces]
        return None if rows[0] is None else np.concatenate([r[k] for r, k in zip(rows, keep, strict=True)])

    return Drawn(column("position"), column("color"), column("normal"))


@pytest.mark.parametrize("name", SAID)
def test_cases__come_out_as_their_maker_made_them(name, tmp_path):
    path = case(name, tmp_path)
    truth = np.load(CASES / "truth" / f"{name.partition('.')[0]}.npz")
    source, got = over_all_points(open_scan(path), lambda s, looks: drawn(s))
    n_true = len(truth["position"]) - (40 if name == "las_withheld.las" else 0)
    assert len(got.position) == n_true
    step = 0.5 if name == "ply_utm_float.ply" else 0.0011
    np.testing.assert_allclose(got.position, truth["position"][:n_true], rtol=0, atol=step)
    if "color" in truth and got.color is not None:
        assert np.abs(got.color.astype(int) - truth["color"][:n_true]).max() <= 2
    assert (got.color is None) == ("color" not in truth)
    if "normal" in truth and name != "e57_merged_object.e57":
        unit = got.normal / np.linalg.norm(got.normal, axis=1, keepdims=True)
        assert np.degrees(np.arccos(np.clip((unit * truth["normal"]).sum(axis=1), -1, 1))).max() < 5
    if "n_cameras" in truth:
        assert len(source.cameras) == truth["n_cameras"]
        for i, camera in enumerate(source.cameras):
            assert source.read_photo(i).shape == (camera.height_px, camera.width_px, 3)


@pytest.mark.parametrize("name", SAID)
def test_cases__a_run_of_points_is_the_same_read_from_its_middle(name, tmp_path):
    source = open_scan(case(name, tmp_path))
    if source.read_slice is None:
        return
    whole = list(source.pieces(source.n_points))
    for first in (0, source.n_points // 3):
        run = list(source.read_slice(first, source.n_points, 100))
        for column in ("position", "color", "normal"):
            rows = [getattr(p, column) for p in whole]
            if rows[0] is not None:
                expected = np.concatenate(rows)[first:]
                np.testing.assert_array_equal(np.concatenate([getattr(p, column) for p in run]), expected)


@pytest.mark.parametrize("name", SAID)
def test_cases__check_and_inspect_say_it_before(name, tmp_path):
    path = case(name, tmp_path)
    findings = check_scan(str(path))
    assert all(f.severity != "error" for f in findings)
    assert SAID[name] in " ".join(f.text for f in findings)
    header = inspect_scan(str(path))
    if name not in OF_POINTS:
        assert SAID[name] in " ".join([*header["warnings"], *header["unused_properties"]])


def test_cases__a_merged_cloud_has_no_scanner(tmp_path):
    assert open_scan(case("e57_merged_object.e57", tmp_path)).stations == ()


@pytest.mark.parametrize("name", ["las_harm_panic.laz", "las_harm_flip.las"])
def test_cases__harm_ends_in_one_line_or_in_a_scan(name, tmp_path):
    path = case(name, tmp_path)
    try:
        source = open_scan(path)
        assert sum(len(p.position) for p in source.pieces(1000)) == source.n_points
        assert source.warnings
    except InvalidScan as error:
        assert name in str(error) and "\n" not in str(error)
