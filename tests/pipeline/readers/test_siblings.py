"""Made files of the kinds that tests/pipeline/readers/test_cases.py has, and of their siblings: each right, and
said."""

import shutil
import struct
import unicodedata
import zipfile

import laspy
import numpy as np
import pytest
from laspy.vlrs.vlr import VLR

from pipeline.readers import open_scan
from pipeline.readers.attributes.marks import NUMBER
from pipeline.readers.attributes.options import ReadOptions
from pipeline.readers.check import check_scan
from storage.errors import InvalidScan, UnsupportedScan
from tests.pipeline.readers import test_e57 as e57
from tests.pipeline.readers.workspace import write_workspace, zip_folder

N = 500


def gather(source, name, n=90):
    rows = [getattr(p, name) for p in source.pieces(n)]
    return None if any(r is None for r in rows) else np.concatenate(rows)


def marks(source):
    pieces = list(source.pieces(90))
    return np.concatenate([np.zeros(len(p.position), np.uint8) if p.mark is None else p.mark for p in pieces])


def said(source):
    return " ".join(source.warnings)


# --- what was not measured, in formats that have no word for it ---


@pytest.mark.parametrize("ending", ["ply", "xyz", "pcd"])
def test_points__of_empty_pixels_are_left_out_and_may_be_kept(tmp_path, ending):
    rows = np.random.default_rng(0).random((N, 3)) + 1
    rows[: N // 2] = 0
    path = tmp_path / f"a.{ending}"
    heads = {
        "ply": f"ply\nformat ascii 1.0\nelement vertex {N}\n"
        + "".join(f"property float {c}\n" for c in "xyz")
        + "end_header",
        "xyz": "",
        "pcd": f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {N}\nHEIGHT 1\nPOINTS {N}\nDATA ascii",
    }
    np.savetxt(path, rows, fmt="%.6f", header=heads[ending], comments="")
    source, kept = open_scan(path), open_scan(path, ReadOptions(marked_points="range-zero=keep"))
    assert (marks(source) == np.where(np.arange(N) < N // 2, NUMBER["range-zero"], 0)).all() and not marks(kept).any()
    assert any("250 of 500 points lie at their scanner's own origin" in f.text for f in check_scan(path))
    found = check_scan(path, ReadOptions(marked_points="range-zero=keep"))
    assert any("250 of 500 points lie at (0, 0, 0)" in f.text for f in found)


def test_points__one_at_the_origin_is_a_point(tmp_path):
    rows = np.random.default_rng(0).random((50, 3))
    rows[7] = 0
    np.savetxt(tmp_path / "a.xyz", rows, fmt="%.6f")
    assert not marks(open_scan(tmp_path / "a.xyz")).any()
    assert not any("(0, 0, 0)" in f.text for f in check_scan(tmp_path / "a.xyz") if f.severity == "warning")


# --- PLY ---


def test_ply__a_byte_order_mark_is_passed_over_before_text_and_named_before_data(tmp_path):
    text = (
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    path = tmp_path / "a.ply"
    path.write_bytes(b"\xef\xbb\xbf" + text + b"1 2 3\n")
    assert gather(open_scan(path), "position").tolist() == [[1, 2, 3]]
    path.write_bytes(b"\xef\xbb\xbf" + text.replace(b"ascii", b"binary_little_endian") + bytes(12))
    with pytest.raises(InvalidScan, match="a byte order mark of UTF-8 before a header of binary data"):
        open_scan(path)
    path.write_bytes((text + b"1 2 3\n").decode().encode("utf-16"))
    with pytest.raises(InvalidScan, match="text in UTF-16"):
        open_scan(path)


def write_ply(path, columns, end="\n"):
    types = {"f": "float", "d": "double", "B": "uchar", "H": "ushort", "i": "int"}
    random = np.random.default_rng(0)
    columns = {"x": random.random(N).astype("f"), "y": random.random(N).astype("f"), "z": np.zeros(N, "f")} | columns
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {N}"]
    head += [f"property {types[v.dtype.char]} {k}" for k, v in columns.items()]
    rows = np.zeros(N, [(k, v.dtype) for k, v in columns.items()])
    for k, v in columns.items():
        rows[k] = v
    path.write_bytes(end.join([*head, "end_header", ""]).encode() + rows.tobytes())
    return path


def ramps(dtype, top, names):
    return {n: (np.linspace(0, top, N) * (1 - 0.1 * i)).astype(dtype) for i, n in enumerate(names)}


@pytest.mark.parametrize(
    "names",
    [
        ("red", "green", "blue"),
        ("r", "g", "b"),
        ("diffuse_red", "diffuse_green", "diffuse_blue"),
        ("scalar_R", "scalar_G", "scalar_B"),
        ("Red", "Green", "Blue"),
        ("color_r", "color_g", "color_b"),
    ],
)
@pytest.mark.parametrize(("dtype", "top"), [("B", 255), ("H", 65535), ("H", 255), ("f", 1.0), ("f", 255.0), ("i", 255)])
def test_ply__colours_by_any_name_and_of_any_type(tmp_path, names, dtype, top):
    columns = ramps(dtype, top, names)
    got = gather(open_scan(write_ply(tmp_path / "a.ply", columns)), "color")
    expected = np.stack([columns[n] for n in names], axis=1) * (255 / top)
    assert np.abs(got - expected).max() <= 1


def test_ply__colours_of_gaussian_splatting_have_its_scale(tmp_path):
    columns = {f"f_dc_{i}": np.linspace(-2, 2, N).astype("f") for i in range(3)}
    source = open_scan(write_ply(tmp_path / "a.ply", columns | {"opacity": np.ones(N, "f")}))
    expected = np.clip(0.5 + 0.28209479 * np.linspace(-2, 2, N), 0, 1) * 255
    assert np.abs(gather(source, "color")[:, 0] - expected).max() <= 1 and source.unused == ("opacity",)


@pytest.mark.parametrize(
    "names", [("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"), ("NormalX", "NormalY", "NormalZ")]
)
def test_ply__normals_by_any_name(tmp_path, names):
    columns = {n: np.full(N, v, "f") for n, v in zip(names, (0, 0.6, 0.8), strict=True)}
    source = open_scan(write_ply(tmp_path / "a.ply", columns))
    assert source.has_normals and np.allclose(gather(source, "normal"), [0, 0.6, 0.8])


@pytest.mark.parametrize("name", ["intensity", "scalar_Intensity", "reflectance", "scalar_intensity", "Remission"])
def test_ply__intensity_by_any_name_unless_it_is_constant(tmp_path, name):
    source = open_scan(write_ply(tmp_path / "a.ply", {name: np.linspace(3, 90, N).astype("f")}))
    assert source.has_intensity and np.allclose(gather(source, "intensity"), np.linspace(3, 90, N))
    source = open_scan(write_ply(tmp_path / "b.ply", {name: np.full(N, 7, "f")}))
    assert not source.has_intensity and "constant (7)" in said(source)


@pytest.mark.parametrize("value", [0, 255])
def test_ply__colours_that_are_all_black_or_white_are_not_used(tmp_path, value):
    source = open_scan(write_ply(tmp_path / "a.ply", {c: np.full(N, value, "B") for c in ("red", "green", "blue")}))
    assert not source.has_colors and "colours are" in said(source) and gather(source, "color") is None


def test_ply__a_colour_of_its_own_is_used_though_it_is_constant(tmp_path):
    columns = {c: np.full(N, v, "B") for c, v in (("red", 200), ("green", 30), ("blue", 30))}
    assert open_scan(write_ply(tmp_path / "a.ply", columns)).has_colors


def test_ply__mixed_line_ends_in_a_header(tmp_path):
    path = write_ply(tmp_path / "a.ply", {})
    whole = path.read_bytes()
    path.write_bytes(whole.replace(b"ply\nformat", b"ply\r\nformat", 1).replace(b"\nelement", b"\r\nelement", 1))
    np.testing.assert_array_equal(gather(open_scan(path), "position")[:, 2], 0)


# --- LAS ---


def las_header(points=N, version="1.4", point_format=7):
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.scales, header.offsets = [0.001] * 3, [0] * 3
    scan = laspy.LasData(header)
    random = np.random.default_rng(1)
    scan.x, scan.y, scan.z = random.uniform(0, 10, (3, points))
    if "red" in scan.point_format.dimension_names:
        scan.red, scan.green, scan.blue = random.integers(0, 65536, (3, points))
    return scan


def set_flag(scan, name, rows):
    values = np.zeros(len(scan.x), np.uint8)
    values[rows] = 1
    setattr(scan, name, values)


@pytest.mark.parametrize(("version", "point_format"), [("1.2", 3), ("1.4", 7)])
@pytest.mark.parametrize("mark", ["withheld", "synthetic", "noise", "overlap"])
def test_las__marked_points_are_left_out_counted_and_may_be_kept(tmp_path, version, point_format, mark):
    scan = las_header(version=version, point_format=point_format)
    rows = np.arange(10, 30)
    if mark == "noise":
        classes = np.ones(N, np.uint8)
        classes[rows[:10]], classes[rows[10:]] = 7, 18
        scan.classification = classes
    elif mark == "overlap" and point_format == 3:
        classes = np.ones(N, np.uint8)
        classes[rows] = 12
        scan.classification = classes
    else:
        set_flag(scan, mark, rows)
    path = tmp_path / "a.las"
    scan.write(str(path))
    usual, other = ("keep", "leave-out") if mark == "overlap" else ("leave-out", "keep")
    for choice, n in ((usual, 0 if usual == "keep" else 20), (other, 0 if other == "keep" else 20)):
        found = marks(open_scan(path, ReadOptions(marked_points=f"{mark}={choice}")))
        assert np.count_nonzero(found) == n and set(found[found > 0]) <= {NUMBER[mark]}
        text = " ".join(f.text for f in check_scan(str(path), ReadOptions(marked_points=f"{mark}={choice}")))
        assert ("20 of 500 points" in text) == (n == 20)


def test_las__a_mark_that_all_points_bear_is_ignored_and_said(tmp_path):
    scan = las_header()
    set_flag(scan, "synthetic", np.arange(N))
    scan.write(str(tmp_path / "a.las"))
    source = open_scan(tmp_path / "a.las")
    assert not marks(source).any() and "ignored" in said(source)


@pytest.mark.parametrize(
    ("scaled", "top", "word"),
    [
        (lambda v: v * 257, 65535, ""),
        (lambda v: v * 256, 65535, ""),
        (lambda v: v, 255, "8-bit"),
        (lambda v: np.where(v > 250, 256, v), 255, "8-bit"),
        (lambda v: v * 4095 // 255, 4095, "12-bit"),
        (lambda v: np.where(np.arange(N) == 3, 65535, v), 255, "8-bit"),
        (lambda v: np.where(np.arange(N) == 3, 65535, v * 4095 // 255), 4095, "12-bit"),
        (lambda v: v // 17 * 257, 65535, ""),  # a dark scan of 8 bits that were made 16
    ],
)
def test_las__ranges_are_told_from_all_values(tmp_path, scaled, top, word):
    scan, values = las_header(), np.random.default_rng(2).integers(0, 256, (3, N))
    colors = np.stack([scaled(v) for v in values])
    scan.red, scan.green, scan.blue = colors
    scan.write(str(tmp_path / "a.las"))
    source = open_scan(tmp_path / "a.las")
    expected = np.clip(colors.T * (255 / top), 0, 255)
    assert np.abs(gather(source, "color") - expected).max() <= 2
    assert word in said(source)


def test_las__normals_of_extra_bytes_are_used_and_others_listed(tmp_path):
    scan = las_header()
    for name, value in (("NormalX", 0.0), ("NormalY", 0.6), ("NormalZ", 0.8), ("Roughness", 1.0)):
        scan.add_extra_dim(laspy.ExtraBytesParams(name, "f4"))
        scan[name] = np.full(N, value)
    scan.write(str(tmp_path / "a.laz"))
    source = open_scan(tmp_path / "a.laz")
    assert source.has_normals and np.allclose(gather(source, "normal"), [0, 0.6, 0.8]) and "Roughness" in source.unused


WKT = (
    'COMPD_CS["Stra\xdfe",PROJCS["p",GEOGCS["g",UNIT["degree",0.017]],UNIT["US survey foot",0.304800609601219]],'
    'VERT_CS["h",VERT_DATUM["d",2005],UNIT["metre",1]]]'
)


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_las__heights_in_another_unit_are_named_whatever_the_letters_of_the_wkt(tmp_path, encoding):
    scan = las_header()
    scan.header.vlrs.append(VLR("LASF_Projection", 2112, "", WKT.encode(encoding) + b"\0"))
    scan.write(str(tmp_path / "a.las"))
    source = open_scan(tmp_path / "a.las")
    assert (
        source.unit == "US survey foot"
        and "heights are in metre and its other coordinates in US survey foot" in said(source)
    )
    scaled = open_scan(tmp_path / "a.las", ReadOptions(height_scale=1 / 0.3048006096))
    assert "not scaled" not in said(scaled)
    ratio = gather(scaled, "position")[:, 2] / gather(source, "position")[:, 2]
    np.testing.assert_allclose(ratio, 3.2808333, rtol=1e-6)


def test_las__records_that_run_into_the_points_are_named_and_the_points_read(tmp_path):
    scan = las_header()
    scan.header.vlrs.append(VLR("somebody", 7, "", bytes(50)))
    path = tmp_path / "a.las"
    scan.write(str(path))
    whole = bytearray(path.read_bytes())
    struct.pack_into("<H", whole, 375 + 20, 60_000)  # the length of the record
    path.write_bytes(whole)
    assert len(gather(open_scan(path), "position")) == N and "runs into the points" in said(open_scan(path))
    struct.pack_into("<I", whole, 100, 0xFFFFFFFF)  # the number of records
    struct.pack_into("<H", whole, 375 + 20, 50)
    path.write_bytes(whole)
    assert "4,294,967,295 variable length records promised" in said(open_scan(path))


def test_las__steps_that_are_not_small_against_the_spacing_are_named(tmp_path):
    scan = las_header()
    scan.header.scales = [1.0] * 3
    scan.x = scan.y = scan.z = np.random.default_rng(0).integers(0, 3, N)
    scan.write(str(tmp_path / "a.las"))
    assert "differ by 1 at least" in " ".join(f.text for f in check_scan(str(tmp_path / "a.las")))


# --- E57 ---


def test_e57__colours_and_intensities_marked_as_invalid_are_left_out(tmp_path):
    state = np.where(np.arange(50) % 5 == 0, 1, 0)
    scan = e57.cartesian(50) | {c: np.arange(50) * 5 for c in e57.COLOR} | {"isColorInvalid": state}
    assert np.count_nonzero(marks(open_scan(e57.write(tmp_path / "a.e57", scan))) == NUMBER["no-color"]) == 10
    scan = e57.cartesian(50) | {"intensity": np.linspace(0, 1, 50), "isIntensityInvalid": state}
    assert np.count_nonzero(marks(open_scan(e57.write(tmp_path / "b.e57", scan))) == NUMBER["no-intensity"]) == 10
    kept = ReadOptions(marked_points="no-intensity=keep")
    assert not marks(open_scan(tmp_path / "b.e57", kept)).any()


def test_e57__a_station_whose_colours_are_all_invalid_has_none_and_is_drawn(tmp_path):
    scan = e57.cartesian(50) | {c: np.arange(50) * 5 for c in e57.COLOR} | {"isColorInvalid": np.ones(50, int)}
    source = open_scan(e57.write(tmp_path / "a.e57", scan))
    assert not source.has_colors and not marks(source).any() and "invalid" in said(source)


def test_e57__points_at_the_scanner_are_left_out_in_cartesian_and_spherical(tmp_path):
    columns = e57.cartesian(50)
    for c in e57.CARTESIAN:
        columns[c][:20] = 0
    spherical = dict(
        zip(e57.SPHERICAL, (np.r_[np.zeros(5), np.ones(45)], np.linspace(0, 3, 50), np.zeros(50)), strict=True)
    )
    source = open_scan(
        e57.write(tmp_path / "a.e57", columns | {"pose": e57.pose_of((1, 0, 0, 0), (5, 5, 5))}, spherical)
    )
    found = marks(source) == NUMBER["range-zero"]
    assert found[:50].sum() == 20 and found[50:].sum() == 5
    assert source.stations == ((5, 5, 5), (0, 0, 0))


def test_e57__rows_and_columns_make_a_station_at_the_origin_and_nothing_makes_none(tmp_path):
    grid = {"rowIndex": np.arange(50), "columnIndex": np.zeros(50, int)}
    assert open_scan(e57.write(tmp_path / "a.e57", e57.cartesian(50) | grid)).stations == ((0, 0, 0),)
    source = open_scan(e57.write(tmp_path / "b.e57", e57.cartesian(50)))
    assert source.stations == () and gather(source, "station") is None


def test_e57__a_station_that_cannot_be_read_is_named_and_the_others_are(tmp_path):
    broken = e57.cartesian(10) | {"pose": e57.pose_of((0, 0, 0, 0), (0, 0, 0))}
    source = open_scan(e57.write(tmp_path / "a.e57", e57.cartesian(30), broken, e57.cartesian(20, seed=3)))
    assert source.n_points == 50 and "quaternion that is not 0" in said(source)


def test_e57__8_bit_colours_in_limits_of_16_bits(tmp_path):
    limits = {f"{c}{end}": v for c in e57.COLOR for end, v in (("Minimum", 0), ("Maximum", 65535))}
    scan = e57.cartesian(50) | {c: np.arange(50) * 5 for c in e57.COLOR} | {"colorLimits": limits}
    source = open_scan(e57.write(tmp_path / "a.e57", scan))
    np.testing.assert_array_equal(gather(source, "color")[:, 0], np.arange(50) * 5)
    assert "8-bit" in said(source)


@pytest.mark.parametrize("station", ["1,2,3", " 1, 2.0,3e0"])
def test_station__may_be_given(tmp_path, station):
    source = open_scan(e57.write(tmp_path / "b.e57", e57.cartesian(50)), ReadOptions(station=station))
    assert source.stations == ((1, 2, 3),) and not gather(source, "station").any()


# --- workspaces ---


def test_colmap__photographs_are_found_however_they_are_spelled(tmp_path):
    for spelled in (
        unicodedata.normalize("NFC", "Tür 0.png"),
        unicodedata.normalize("NFD", "Tür 0.png"),
        "TÜR 0.PNG",
        "sub/Tür 0.png",
    ):
        made = write_workspace(tmp_path / "w", ending=".txt")
        images = made.path / "sparse" / "images.txt"
        images.write_text(images.read_text().replace("0000.png", "Tür 0.png"))
        target = made.path / "images" / spelled
        target.parent.mkdir(exist_ok=True)
        (made.path / "images" / "0000.png").rename(target)
        source = open_scan(made.path)
        assert len(source.cameras) == 3 and source.read_photo(0).shape == (48, 64, 3)
        assert len(open_scan(zip_folder(made.path, tmp_path / "w.zip")).cameras) == 3
        shutil.rmtree(made.path)


def test_colmap__two_files_that_fit_are_both_named(tmp_path):
    made = write_workspace(tmp_path / "w")
    content = (made.path / "images" / "0000.png").read_bytes()
    (made.path / "images" / "0000.png").unlink()
    for name in ("0000.PNG", "0000.Png"):
        (made.path / "images" / name).write_bytes(content)
    source = open_scan(made.path)
    assert len(source.cameras) == 2 and "'images/0000.PNG' and 'images/0000.Png' both fit" in said(source)


def test_colmap__zips_of_other_programs_with_backslashes_and_junk(tmp_path):
    made = write_workspace(tmp_path / "w")
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        for file in sorted(made.path.rglob("*")):
            if file.is_file():
                entry = zipfile.ZipInfo("scan\\dense\\0\\" + str(file.relative_to(made.path)).replace("/", "\\"))
                archive.writestr(entry, file.read_bytes())
        for junk in ("scan/.DS_Store", "Thumbs.db", "__MACOSX/scan/._fused.ply", "scan/desktop.ini"):
            archive.writestr(junk, b"junk")
    source = open_scan(tmp_path / "a.zip")
    assert len(source.cameras) == 3 and source.has_visibility
    np.testing.assert_array_equal(gather(source, "position"), gather(open_scan(made.path), "position"))


@pytest.mark.parametrize("suffix", [".ply", ".las", ".laz", ".e57"])
@pytest.mark.parametrize("packed", [False, True])
def test_container__one_file_of_points_is_found_beside_notes(tmp_path, suffix, packed):
    inside = tmp_path / "scan" / "deep"
    inside.mkdir(parents=True)
    if suffix == ".ply":
        write_ply(inside / "a.ply", ramps("B", 255, ("red", "green", "blue")))
    elif suffix == ".e57":
        e57.write(inside / "a.e57", e57.cartesian(N))
    else:
        las_header().write(str(inside / f"a{suffix}"))
    (tmp_path / "scan" / "readme.txt").write_text("about it")
    path = zip_folder(tmp_path / "scan", tmp_path / "a.zip") if packed else tmp_path / "scan"
    source = open_scan(path)
    assert (
        source.n_points == N
        and len(gather(source, "position")) == N
        and "splatpress-" not in source.path + said(source)
    )


def test_container__several_files_of_points_are_named(tmp_path):
    write_ply(tmp_path / "a.ply", {})
    write_ply(tmp_path / "b.ply", {})
    with pytest.raises(InvalidScan, match=r"2 files of points \(a.ply, b.ply\)"):
        open_scan(tmp_path)


TEXTS = {
    "bom": (lambda t: "\ufeff" + t, None),
    "utf-16": (lambda t: t.encode("utf-16"), None),
    "crlf": (lambda t: t.replace("\n", "\r\n"), None),
    "cr": (lambda t: t.replace("\n", "\r"), None),
    "one line an image": (lambda t: "\n".join(line for line in t.split("\n") if not line.startswith("7 7")), None),
    "four digits": (lambda t: t.replace(" 1 0 0 0 ", " 0.99995 0.0001 0 0 "), None),
    "decimal commas": (lambda t: t.replace(" 0 ", " 0,5 ", 1), r"images.txt:line \d+, column \d+: '0,5'"),
    "a short line": (lambda t: t + "9 1 0 0\n", r"images.txt:line \d+: 4 values"),
    "a quaternion of 0": (lambda t: t.replace("1 1 0 0 0", "1 0 0 0 0"), "a quaternion of 0"),
}


@pytest.mark.parametrize("kind", TEXTS)
def test_colmap__text_models_as_people_leave_them(tmp_path, kind):
    made = write_workspace(tmp_path / "w", ending=".txt")
    for name in ("rigs.txt", "frames.txt"):
        (made.path / "sparse" / name).unlink()
    file = made.path / "sparse" / "images.txt"
    change, error = TEXTS[kind]
    before = open_scan(made.path).cameras
    text = change(file.read_text())
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    if error:
        with pytest.raises(InvalidScan, match=error):
            open_scan(made.path)
        return
    after = open_scan(made.path).cameras
    assert [c.name for c in after] == [c.name for c in before]
    for a, b in zip(after, before, strict=True):
        np.testing.assert_allclose(a.rotation, b.rotation, atol=1e-3)


def test_colmap__a_camera_model_that_cannot_be_undistorted_is_named(tmp_path):
    made = write_workspace(tmp_path / "w", ending=".txt")
    cameras = made.path / "sparse" / "cameras.txt"
    for model, found in (
        ("EQUIRECTANGULAR 64 48", "EQUIRECTANGULAR"),
        ("SPHERE 64 48", "SPHERE"),
        ("FISHEYE8 64 48 1", "FISHEYE8"),
    ):
        cameras.write_text(f"1 {model}\n")
        with pytest.raises((UnsupportedScan, InvalidScan), match=found) as error:
            open_scan(made.path)
        assert ".cc:" not in str(error.value)


def test_colmap__the_model_that_fits_is_used_or_that_which_is_named(tmp_path):
    made = write_workspace(tmp_path / "w")
    other = write_workspace(tmp_path / "o", params=(30.0, 30.0, 20.0, 30.0))
    (made.path / "sparse").rename(made.path / "right")
    (made.path / "sparse").mkdir()
    (made.path / "right").rename(made.path / "sparse" / "1")
    shutil.copytree(other.path / "sparse", made.path / "sparse" / "0")
    source = open_scan(made.path)
    assert source.details["model"].endswith("sparse/1") and source.cameras[0].fx_px == 60
    assert "sparse/1" in said(source) and "sparse/0" in said(source)
    assert open_scan(made.path, ReadOptions(sparse_model="sparse/0")).cameras[0].fx_px == 30
    with pytest.raises(InvalidScan, match="no model in 'sparse/7'.*sparse/0, sparse/1"):
        open_scan(made.path, ReadOptions(sparse_model="sparse/7"))


def test_paths__that_are_no_utf_8_are_read_and_shown(tmp_path):
    for name, make in (
        (b"f\xfcr.ply", lambda p: write_ply(p, {})),
        (b"f\xfcr.laz", lambda p: las_header().write(str(p))),
    ):
        made = tmp_path / f"plain{name[-4:].decode()}"
        make(made)
        path = tmp_path / name.decode("utf-8", "surrogateescape")
        made.rename(path)
        source = open_scan(path)
        assert source.path.endswith(f"für{name[-4:].decode()}") and len(gather(source, "position")) == N


# --- files of other kinds, named for what they are ---


@pytest.mark.parametrize(
    "name, content, error, found",
    [
        ("a.ply", b"\x1f\x8b\x08\0", InvalidScan, "packed by gzip, whatever its name says; .*unpack it first"),
        ("a.las", b"PK\x03\x04", InvalidScan, "packed by a .zip"),
        ("a.xyz.gz", b"\x1f\x8b\x08\0", UnsupportedScan, "unpack it first"),
        ("a.rcp", b"", UnsupportedScan, "export it as .e57"),
        ("a.splat", b"", UnsupportedScan, "Gaussians are no scan"),
        ("a.asc", b"ncols 4\nnrows 2\n1 2 3 4\n1 2 3 4\n", UnsupportedScan, "an ESRI ASCII grid"),
        ("a.txt", b"DSAA\n2 2\n0 1\n0 1\n0 1\n1 2 3\n1 2 3\n", UnsupportedScan, "a Surfer grid"),
    ],
)
def test_open__what_is_of_another_kind_is_named(tmp_path, name, content, error, found):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(error, match=found):
        open_scan(tmp_path / name)


@pytest.mark.parametrize(
    "other, program", [("sfm_data.json", "OpenMVG"), ("cameras.xml", "Metashape"), ("a.nvm", "VisualSFM")]
)
def test_container__photographs_without_cameras_that_are_known_are_said(tmp_path, other, program):
    made = write_workspace(tmp_path / "scan")
    shutil.rmtree(made.path / "sparse")
    (made.path / other).write_text("{}")
    assert f"3 photographs and cameras of {program} (there is no COLMAP model" in said(open_scan(made.path))


def test_colmap__a_camera_that_sees_the_whole_sphere_is_named_whatever_its_parameters(tmp_path):
    made = write_workspace(tmp_path / "scan", ending=".txt")
    (made.path / "sparse" / "cameras.txt").write_text("1 EQUIRECTANGULAR 64 48\n")
    with pytest.raises(UnsupportedScan, match="line 1: camera model EQUIRECTANGULAR; .*six sides of a cube"):
        open_scan(made.path)


def test_las__a_count_of_0_before_points_and_places_from_the_earths_centre_are_said(tmp_path):
    scan = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    scan.x = scan.y = scan.z = np.arange(50.0)
    wkt = b'GEOCCS["WGS 84",DATUM["D",SPHEROID["S",6378137,298.3]],PRIMEM["G",0],UNIT["metre",1]]'
    scan.header.vlrs.append(VLR("LASF_Projection", 2112, "", wkt))
    scan.write(tmp_path / "a.las")
    assert "earth's centre" in said(open_scan(tmp_path / "a.las")) and open_scan(tmp_path / "a.las").unit == "metre"
    whole = bytearray((tmp_path / "a.las").read_bytes())
    whole[107:111] = bytes(4)
    (tmp_path / "b.las").write_bytes(whole)
    with pytest.raises(InvalidScan, match="point_count: 0 points, with 1700 bytes after"):
        open_scan(tmp_path / "b.las")


def test_ptx__an_empty_block_and_a_matrix_that_scales_are_said(tmp_path):
    axes = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n"
    scaled, turn = "2 0 0 0\n0 2 0 0\n0 0 2 0\n0 0 0 1\n", "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    points = "".join(f"{i} 1 2 0.{i}\n" for i in range(1, 10))
    (tmp_path / "a.ptx").write_text(f"3\n3\n{axes}{scaled}{points}0\n0\n{axes}{turn}")
    source = open_scan(tmp_path / "a.ptx")
    assert "block 2 has no points" in said(source) and "block 1 scales points by 2, 2, 2" in said(source)
    assert gather(source, "position")[0].tolist() == [2, 2, 4]


@pytest.mark.parametrize("scale, is_told", [(1e-5, True), (1.0, False)])
def test_text__coordinates_that_may_be_degrees_are_said(tmp_path, scale, is_told):
    rows = np.random.default_rng(0).random((50, 3)) * [scale, scale, 5] + [11.5, 48.1, 500]
    np.savetxt(tmp_path / "a.xyz", rows, fmt="%.9f")
    assert any("may be degrees" in f.text for f in check_scan(tmp_path / "a.xyz")) == is_told


def test_las__colours_of_extra_bytes_are_used_where_the_format_has_none(tmp_path):
    header = laspy.LasHeader(point_format=1, version="1.2")
    for name in ("Red", "Green", "Blue"):
        header.add_extra_dim(laspy.ExtraBytesParams(name, "u1"))
    scan = laspy.LasData(header)
    scan.x, scan.y, scan.z = np.random.default_rng(0).random((3, N))
    color = np.random.default_rng(1).integers(0, 256, (N, 3)).astype(np.uint8)
    scan["Red"], scan["Green"], scan["Blue"] = color.T
    scan.write(tmp_path / "a.las")
    source = open_scan(tmp_path / "a.las")
    assert (gather(source, "color") == color).all() and not {"Red", "Green", "Blue"} & set(source.unused)


@pytest.mark.parametrize(
    "low, high, is_told", [(-5.0, 5.0, True), (0.0, 100.0, True), (0.0, 9.99, False), (0, 14.0, False)]
)
def test_las__bounds_that_points_leave_or_do_not_fill_are_said(tmp_path, low, high, is_told):
    scan = laspy.LasData(laspy.LasHeader(point_format=0, version="1.2"))
    scan.x = scan.y = scan.z = np.linspace(0, 9.99, 50)
    scan.write(tmp_path / "a.las")
    whole = bytearray((tmp_path / "a.las").read_bytes())
    struct.pack_into("<2d", whole, 179, high, low)
    (tmp_path / "a.las").write_bytes(whole)
    assert any("its bounds are wrong" in f.text for f in check_scan(tmp_path / "a.las")) == is_told
