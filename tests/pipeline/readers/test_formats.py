"""PTX, PTS, XYZ and PCD, on files written here."""

import numpy as np
import pytest

from pipeline.readers import open_scan
from pipeline.readers.attributes.marks import NUMBER
from pipeline.readers.pcd.lzf import unpack
from storage.errors import InvalidScan


def points(n=200, seed=0):
    random = np.random.default_rng(seed)
    position = np.round(random.normal(size=(n, 3)), 4)
    color = random.integers(0, 256, (n, 3))
    normal = random.normal(size=(n, 3))
    return position, color, normal / np.linalg.norm(normal, axis=1, keepdims=True)


def read(path, n=60):
    pieces = list(open_scan(path).pieces(n))
    names = ("position", "color", "normal", "intensity", "station", "mark")
    columns = {k: [getattr(p, k) for p in pieces] for k in names}
    return {k: None if any(x is None for x in v) else np.concatenate(v) for k, v in columns.items()}


def write_text(path, *columns, header="", delimiter=" ", end="\n"):
    rows = np.column_stack(columns)
    lines = [delimiter.join(f"{v:g}" if v == int(v) else f"{v:.6f}" for v in row) for row in rows]
    path.write_bytes((header + end.join(lines) + end).encode())
    return path


# --- text ---


@pytest.mark.parametrize("suffix", [".xyz", ".txt", ".asc", ".csv", ".pts"])
@pytest.mark.parametrize("delimiter", [" ", ",", ";", "\t"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_table__columns_are_told_from_their_values_and_said(tmp_path, suffix, delimiter, end):
    position, color, normal = points()
    path = write_text(tmp_path / f"a{suffix}", position, color, normal, delimiter=delimiter, end=end)
    got = read(path)
    np.testing.assert_allclose(got["position"], position, atol=1e-6)
    np.testing.assert_array_equal(got["color"], color)
    np.testing.assert_allclose(got["normal"], normal, atol=1e-6)
    assert "taken as x y z red green blue nx ny nz" in open_scan(path).warnings[0]


def test_table__a_header_of_cloudcompare_names_the_columns(tmp_path):
    position, color, normal = points()
    header = "//X Y Z Rf Gf Bf Nx Ny Nz Scalar_field\n200\n"
    path = write_text(tmp_path / "a.txt", position, color / 255, normal, np.arange(200), header=header)
    got = read(path)
    assert np.abs(got["color"].astype(int) - color).max() <= 1
    np.testing.assert_allclose(got["normal"], normal, atol=1e-6)
    assert open_scan(path).unused == ("Scalar_field",) and not open_scan(path).warnings


def test_table__pts_of_leica_has_its_number_of_points_first(tmp_path):
    position, color, _ = points()
    intensity = np.arange(200) * 20 - 2000
    path = write_text(tmp_path / "a.pts", position, intensity, color, header="200\r\n", end="\r\n")
    got = read(path)
    np.testing.assert_array_equal(got["intensity"], intensity)
    np.testing.assert_array_equal(got["color"], color)


@pytest.mark.parametrize("last", ["opacity", "intensity"])
def test_table__colours_before_an_opacity_or_an_intensity_are_colours(tmp_path, last):
    position, color, _ = points()
    fourth = np.full(200, 255) if last == "opacity" else np.arange(200) * 20
    got = read(write_text(tmp_path / "a.xyz", position, color, fourth))
    np.testing.assert_array_equal(got["color"], color)
    got = read(write_text(tmp_path / "a.txt", position, np.arange(200) * 20, color))
    np.testing.assert_array_equal(got["color"], color)


def test_table__a_first_column_that_counts_the_points_is_no_coordinate(tmp_path):
    position, color, _ = points()
    path = write_text(tmp_path / "a.txt", np.arange(1, 201), position, color)
    np.testing.assert_allclose(read(path)["position"], position, atol=1e-6)
    assert open_scan(path).unused == ("number",)


def test_table__utf_16_and_quoted_numbers_are_read(tmp_path):
    position, color, _ = points()
    text = write_text(tmp_path / "a.csv", position, color, delimiter=",").read_text()
    quoted = "\n".join(",".join(f'"{w}"' for w in line.split(",")) for line in ["x,y,z,r,g,b", *text.split()])
    for at, content in enumerate((text.encode("utf-16"), quoted.encode(), quoted.encode("utf-16"))):
        (tmp_path / f"{at}.csv").write_bytes(content)
        got = read(tmp_path / f"{at}.csv")
        np.testing.assert_allclose(got["position"], position, atol=1e-6)
        np.testing.assert_array_equal(got["color"], color)


def test_table__decimal_commas_are_named_by_line_and_column(tmp_path):
    (tmp_path / "a.csv").write_text("1.5;2;3\n4;5,5;6\n")
    with pytest.raises(InvalidScan, match=r"a.csv:line 2, column 3: '5,5'.*3 numbers"):
        read(tmp_path / "a.csv")


@pytest.mark.parametrize("text", ["", "hello\nworld\n", "1 2\n3 4\n"])
def test_table__refuses_what_has_no_points(tmp_path, text):
    (tmp_path / "a.xyz").write_text(text)
    with pytest.raises(InvalidScan, match="a.xyz"):
        read(tmp_path / "a.xyz")


# --- PTX ---


def ptx_block(position, color=None, turn=np.eye(3), at=(0, 0, 0)):
    """Points (n, 3) in the scanner's frame, one column of n rows."""
    rows = [*turn, at]
    matrix = "\n".join(" ".join(map(str, [*row, float(i == 3)])) for i, row in enumerate(rows))
    head = f"1\n{len(position)}\n{' '.join(map(str, at))}\n1 0 0\n0 1 0\n0 0 1\n{matrix}\n"
    columns = [position, np.linspace(0, 1, len(position)), *([] if color is None else [color])]
    return head + "\n".join(" ".join(f"{v:g}" for v in row) for row in np.column_stack(columns)) + "\n"


def test_ptx__blocks_have_their_poses_applied_and_what_was_not_hit_is_marked(tmp_path):
    position, color, _ = points(50)
    position[7] = position[9] = 0
    turn = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # x becomes y
    text = ptx_block(position, color) + ptx_block(position, color, turn, (10, 20, 30))
    (tmp_path / "a.ptx").write_text(text)
    got, source = read(tmp_path / "a.ptx"), open_scan(tmp_path / "a.ptx")
    hit = np.setdiff1d(np.arange(50), [7, 9])
    np.testing.assert_allclose(got["position"][hit], position[hit], atol=1e-4)
    there = np.column_stack([-position[:, 1], position[:, 0], position[:, 2]]) + [10, 20, 30]
    np.testing.assert_allclose(got["position"][50 + hit], there[hit], atol=1e-4)
    mark = np.concatenate([np.zeros(len(p.position)) if p.mark is None else p.mark for p in source.pieces(60)])
    assert np.flatnonzero(mark == NUMBER["range-zero"]).tolist() == [7, 9, 57, 59]
    assert source.stations == ((0, 0, 0), (10, 20, 30)) and got["station"].tolist() == [0] * 50 + [1] * 50
    np.testing.assert_array_equal(got["color"][hit], color[hit])


def test_ptx__refuses_every_truncation_and_counts_that_cannot_be(tmp_path):
    whole = ptx_block(points(20)[0])
    for n in range(0, len(whole) - 12, 17):
        (tmp_path / "a.ptx").write_text(whole[:n])
        with pytest.raises(InvalidScan, match="a.ptx"):
            read(tmp_path / "a.ptx")
    (tmp_path / "a.ptx").write_text(whole.replace("\n20\n", "\n4000000000\n", 1))
    with pytest.raises(InvalidScan, match="4000000000 points in a file of"):
        read(tmp_path / "a.ptx")


# --- PCD ---


def lzf_literals(data):
    return b"".join(bytes([len(data[i : i + 32]) - 1]) + data[i : i + 32] for i in range(0, len(data), 32))


def write_pcd(path, position, color, data="binary", viewpoint="0 0 0 1 0 0 0", height=1):
    packed = (color[:, 0] << 16 | color[:, 1] << 8 | color[:, 2]).astype("<u4")
    n = len(position)
    head = (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\n"
        f"WIDTH {n // height}\nHEIGHT {height}\nVIEWPOINT {viewpoint}\nPOINTS {n}\nDATA {data}\n"
    ).encode()
    rows = np.zeros(n, [("p", "<f4", 3), ("c", "<u4")])
    rows["p"], rows["c"] = position, packed
    if data == "ascii":
        body = "".join(f"{x:.7g} {y:.7g} {z:.7g} {c}\n" for (x, y, z), c in zip(position, packed, strict=True)).encode()
    elif data == "binary":
        body = rows.tobytes()
    else:
        columns = b"".join(np.ascontiguousarray(rows["p"][:, i]).tobytes() for i in range(3)) + packed.tobytes()
        body = lzf_literals(columns)
        body = np.array([len(body), len(columns)], "<u4").tobytes() + body
    path.write_bytes(head + body)
    return path


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_pcd__three_encodings_give_the_same_points(tmp_path, data):
    position, color, _ = points()
    path = write_pcd(tmp_path / "a.pcd", position, color, data)
    for n in (7, 60, 1000):
        got = read(path, n)
        np.testing.assert_allclose(got["position"], position, atol=1e-6)
        np.testing.assert_array_equal(got["color"], color)
    assert open_scan(path).stations == () and open_scan(path).position_type == "float32"


def test_pcd__a_sensor_stands_at_the_viewpoint_or_at_the_origin_of_rows_and_columns(tmp_path):
    position, color, _ = points()
    assert open_scan(write_pcd(tmp_path / "a.pcd", position, color, height=10)).stations == ((0, 0, 0),)
    moved = write_pcd(tmp_path / "b.pcd", position, color, viewpoint="1 2 3 1 0 0 0")
    assert open_scan(moved).stations == ((1, 2, 3),)


@pytest.mark.parametrize("data", ["binary", "binary_compressed"])
def test_pcd__refuses_every_truncation(tmp_path, data):
    whole = write_pcd(tmp_path / "a.pcd", *points(20)[:2], data).read_bytes()
    for n in range(0, len(whole), 13):
        (tmp_path / "a.pcd").write_bytes(whole[:n])
        with pytest.raises(InvalidScan, match="a.pcd"):
            read(tmp_path / "a.pcd")


def test_lzf__references_repeat_what_was_there_and_nothing_else():
    # two literals, then a reference of 5 bytes, 2 back
    assert unpack(np.array([1, 65, 66, 3 << 5, 1], np.uint8), 7).tobytes() == b"ABABABA"
    assert unpack(np.array([1, 65, 66, 3 << 5, 9], np.uint8), 7) is None
    assert unpack(np.array([1, 65, 66], np.uint8), 7) is None
    for length in range(4):
        assert unpack(np.array([1, 65, 66, 255, 255, 255][:length], np.uint8), 300) is None
