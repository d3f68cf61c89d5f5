"""Each sentence of pipeline/readers/ply/ply.py, on files written here and on the real scans."""

import io
import pickle
import struct
from contextlib import nullcontext
from functools import partial

import numpy as np
import pytest

from pipeline.readers import open_scan
from pipeline.readers.check import check_scan
from pipeline.readers.ply.header import MAX_HEADER_BYTES
from pipeline.readers.ply.ply import open_vertices
from storage.errors import InvalidScan
from tests.pipeline.readers.shared_data import shared_scan

TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort", "i4": "int32", "i2": "short", "i1": "char"}
FIELDS = [("red", "u1"), ("x", "f8"), ("quality", "i2"), ("z", "f4"), ("y", "f4")] + [("green", "u1"), ("blue", "u1")]


def table(n=10, fields=FIELDS, seed=0):
    rows = np.zeros(n, fields)
    random = np.random.default_rng(seed)
    for name, kind in fields:
        rows[name] = random.uniform(0, 1, n) if kind[0] == "f" else random.integers(0, 200, n)
    return rows


def write(path, rows, encoding="binary_little_endian", before=(), tail=b"", n_promised=None, extra=()):
    lines = ["ply", f"format {encoding} 1.0", "comment made here", *before]
    lines += [f"element vertex {len(rows) if n_promised is None else n_promised}"]
    lines += [f"property {TYPES[rows.dtype[name].str[1:]]} {name}" for name in rows.dtype.names]
    lines += [*extra, "end_header"]
    if encoding == "ascii":
        data = "".join(" ".join(repr(v.item()) for v in row) + "\n" for row in rows).encode()
    else:
        order = {"binary_little_endian": "<", "binary_big_endian": ">"}[encoding]
        data = rows.astype(rows.dtype.newbyteorder(order)).tobytes()
    path.write_bytes(("\n".join(lines) + "\n").encode() + tail + data)
    return path


def read(path, max_points=4):
    pieces = list(open_scan(path).pieces(max_points))
    keys = ("position", "normal", "color", "intensity")
    columns = {k: [getattr(p, k) for p in pieces] for k in keys}
    return {k: None if v[0] is None else np.concatenate(v) for k, v in columns.items()}


def test_ply__three_encodings_give_the_same_points(tmp_path):
    rows = table()
    for encoding in ("ascii", "binary_little_endian", "binary_big_endian"):
        got = read(write(tmp_path / f"{encoding}.ply", rows, encoding))
        np.testing.assert_array_equal(got["position"], np.stack([rows[c] for c in "xyz"], 1).astype(float))
        np.testing.assert_array_equal(got["color"], np.stack([rows[c] for c in ("red", "green", "blue")], 1))
        assert got["position"].dtype == np.float64 and got["color"].dtype == np.uint8
        assert got["normal"] is None and got["intensity"] is None


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_ply__piece_size_changes_nothing_and_is_never_exceeded(tmp_path, encoding):
    source = open_scan(write(tmp_path / "a.ply", table(11), encoding))
    whole = read(source.path, 100)["position"]
    for n in (1, 3, 11, 12):
        pieces = list(source.pieces(n))
        assert max(len(p.position) for p in pieces) <= n
        np.testing.assert_array_equal(np.concatenate([p.position for p in pieces]), whole)


def test_ply__double_positions_keep_their_digits(tmp_path):
    rows = table(3, [("x", "f8"), ("y", "f8"), ("z", "f8")])
    rows["x"] += 4_500_000.0001
    for encoding in ("ascii", "binary_big_endian"):
        got = read(write(tmp_path / f"{encoding}.ply", rows, encoding))
        np.testing.assert_array_equal(got["position"][:, 0], rows["x"])


def test_ply__normals_and_intensity_are_read(tmp_path):
    fields = [(n, "f4") for n in ("nx", "x", "ny", "y", "nz", "z", "intensity")]
    rows = table(5, fields)
    got = read(write(tmp_path / "a.ply", rows))
    np.testing.assert_array_equal(got["normal"], np.stack([rows[c] for c in ("nx", "ny", "nz")], 1))
    np.testing.assert_array_equal(got["intensity"], rows["intensity"])


def test_ply__two_of_three_normal_components_are_no_normal(tmp_path):
    rows = table(5, [(n, "f4") for n in ("x", "y", "z", "nx", "ny")])
    assert not open_scan(write(tmp_path / "a.ply", rows)).has_normals


@pytest.mark.parametrize(
    ("kind", "values"), [("u2", [0, 257, 65535]), ("f4", [0, 1 / 255, 1]), ("i4", [0, 1, 255]), ("i1", [0, 1, -1])]
)
def test_ply__colours_of_other_types_are_scaled_to_8_bits(tmp_path, kind, values):
    colors = [(f"diffuse_{c}", kind) for c in ("red", "green", "blue")]
    rows = table(3, [("x", "f4"), ("y", "f4"), ("z", "f4"), *colors])
    rows["diffuse_green"] = values
    np.testing.assert_array_equal(read(write(tmp_path / "a.ply", rows))["color"][:, 1], [0, 1, 255])


def test_ply__colours_beyond_1_by_rounding_are_white_and_nan_is_black_and_said(tmp_path):
    rows = table(3, [("x", "f4"), ("y", "f4"), ("z", "f4")] + [(c, "f4") for c in ("red", "green", "blue")])
    for channel in ("red", "green", "blue"):
        rows[channel] = [1.0000001, -1e-9, np.nan]
    scan = write(tmp_path / "a.ply", rows)
    piece = next(open_scan(scan).pieces(10))
    assert piece.color.tolist() == [[255] * 3, [0] * 3, [0] * 3] and piece.colorless.tolist() == [False, False, True]
    assert [f.text for f in check_scan(str(scan)) if f.severity == "warning" and "colour" in f.text] == [
        "1 of 3 points have a colour that is not finite and are drawn black"
    ]


@pytest.mark.parametrize(
    ("word", "value"),
    [
        ("-nan(ind)", np.nan),
        ("nan(snan)", np.nan),
        ("1.#QNAN", np.nan),
        ("-1.#IND", np.nan),
        ("1.#INF00", np.inf),
        ("-1.#INF", -np.inf),
    ],
)
def test_ply__nan_and_infinity_may_be_written_as_on_windows(tmp_path, word, value):
    (tmp_path / "a.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex 3\n{XYZ}end_header\n0 0 0\n1 {word} 2\n1 1 1\n"
    )
    np.testing.assert_array_equal(read(tmp_path / "a.ply")["position"][1], [1, value, 2])


@pytest.mark.parametrize("top", [1.0, 255, 4095, 65535])
@pytest.mark.parametrize("kind", ["f4", "i4", "u2"])
def test_ply__colours_range_over_what_their_values_say(tmp_path, kind, top):
    if top == 1.0 and kind != "f4":
        return
    rows = table(300, [("x", "f4"), ("y", "f4"), ("z", "f4")] + [(c, kind) for c in ("red", "green", "blue")])
    for channel in ("red", "green", "blue"):
        rows[channel] = np.linspace(0, top, 300)
    for encoding in ("ascii", "binary_little_endian", "binary_big_endian"):
        got = read(write(tmp_path / "a.ply", rows, encoding))["color"]
        np.testing.assert_allclose(got[:, 2], rows["blue"] * (255 / top), atol=0.51)


def test_ply__colours_below_zero_are_drawn_as_zero_and_said(tmp_path):
    rows = table(6, [("x", "f4"), ("y", "f4"), ("z", "f4")] + [(c, "i4") for c in ("red", "green", "blue")])
    rows["blue"][5] = -1
    path = write(tmp_path / "a.ply", rows)
    assert read(path)["color"][5, 2] == 0
    assert "1 of its colour values are below 0" in " ".join(open_scan(path).warnings)


def test_ply__nan_positions_are_handed_on(tmp_path):
    rows = table(4, [("x", "f4"), ("y", "f4"), ("z", "f4")])
    rows["y"][2] = np.nan
    for encoding in ("ascii", "binary_little_endian"):
        position = read(write(tmp_path / f"{encoding}.ply", rows, encoding))["position"]
        assert np.isnan(position).tolist() == np.isnan(np.stack([rows[c] for c in "xyz"], 1)).tolist()


def test_ply__scalar_elements_before_the_vertices_are_skipped(tmp_path):
    rows = table(4)
    before = ("element camera 2", "property uchar a", "property double a")
    binary = write(tmp_path / "b.ply", rows, before=before, tail=bytes(18))
    ascii_ = write(tmp_path / "a.ply", rows, "ascii", before=before, tail=b"1 2\n3 4\n")
    np.testing.assert_array_equal(read(binary)["position"], read(ascii_)["position"])
    np.testing.assert_array_equal(read(binary)["position"][:, 0], rows["x"])


def test_ply__lists_after_the_vertices_are_ignored(tmp_path):
    faces = ("element face 7", "property list uchar int vertex_indices")
    source = open_scan(write(tmp_path / "a.ply", table(4), extra=faces))
    assert sum(len(p.position) for p in source.pieces(3)) == 4
    assert source.details["elements"] == {"vertex": 4, "face": 7}


XYZ_LISTS = (
    "property float x\nproperty list uchar int views\nproperty float y\nproperty float z\nproperty list uint float w\n"
)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply__lists_in_and_before_the_vertices_are_skipped(tmp_path, encoding):
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[encoding]
    head = f"ply\nformat {encoding} 1.0\nelement face 2\nproperty list uchar int i\nelement vertex 50\n{XYZ_LISTS}end_header\n"
    random = np.random.default_rng(0)
    rows = [
        (random.normal(size=3).astype(np.float32), random.integers(0, 9, i % 7), random.normal(size=i % 3))
        for i in range(50)
    ]
    faces = [[0, 1, 2], [3, 4, 5, 6]]
    if encoding == "ascii":
        lines = [" ".join(map(str, [len(f), *f])) for f in faces]
        lines += [" ".join(map(str, [p[0], len(v), *v, p[1], p[2], len(w), *w])) for p, v, w in rows]
        data = "\n".join(lines).encode()
    else:
        packed = [np.uint8(len(f)).tobytes() + np.array(f, f"{order}i4").tobytes() for f in faces]
        for p, v, w in rows:
            packed += [
                p[:1].astype(f"{order}f4").tobytes(),
                np.uint8(len(v)).tobytes(),
                v.astype(f"{order}i4").tobytes(),
            ]
            packed += [p[1:].astype(f"{order}f4").tobytes(), np.array([len(w)], f"{order}u4").tobytes()]
            packed += [w.astype(f"{order}f4").tobytes()]
        data = b"".join(packed)
    (tmp_path / "a.ply").write_bytes(head.encode() + data)
    for n in (1, 7, 50):
        np.testing.assert_array_equal(
            read(tmp_path / "a.ply", n)["position"].astype(np.float32), [p for p, _, _ in rows]
        )
    assert set(open_scan(tmp_path / "a.ply").unused) == {"views", "w"}
    for cut in range(1, 60, 7) if encoding != "ascii" else ():
        (tmp_path / "cut.ply").write_bytes((head.encode() + data)[:-cut])
        with pytest.raises(InvalidScan, match="cut.ply"):
            read(tmp_path / "cut.ply")


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_ply__refuses_more_vertices_than_the_file_can_hold_at_open(tmp_path, encoding):
    path = write(tmp_path / "a.ply", table(4), encoding, n_promised=1_000_000_000)
    with pytest.raises(InvalidScan, match=rf"1000000000 vertices promised.* in a file of {path.stat().st_size}"):
        open_scan(path)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_ply__refuses_every_truncation(tmp_path, encoding):
    content = write(tmp_path / "a.ply", table(3), encoding).read_bytes()
    cut = tmp_path / "cut.ply"
    # The last line end of an ASCII file, and the digits before it, cannot be missed.
    end = content.rstrip().rfind(b" ") if encoding == "ascii" else len(content)
    for n in range(end):
        cut.write_bytes(content[:n])
        with pytest.raises(InvalidScan):
            read(cut)


def test_ply__names_the_byte_where_a_stream_ends_early(tmp_path):
    path = write(tmp_path / "a.ply", table(4))
    source = open_scan(path)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(InvalidScan, match=f"ends at byte {path.stat().st_size}"):
        list(source.pieces(2))


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("1 2", ":line 9: 2 values"),
        ("1 2 3 4", ":line 9: 4 values"),
        ("1 2 three", ":line 9, column 5: 'three'"),
        ("1,5 2 3", "'1,5'"),
    ],
)
def test_ply__refuses_an_ascii_row_naming_line_and_column(tmp_path, line, found):
    text = f"ply\nformat ascii 1.0\nelement vertex 3\n{XYZ}end_header\n0 0 0\n{line}\n1 1 1\n1 1 1\n"
    (tmp_path / "a.ply").write_text(text)
    with pytest.raises(InvalidScan, match=f"{found}.*3 numbers"):
        read(tmp_path / "a.ply")


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r", "\n\r"])
@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_ply__lines_may_end_with_anything(tmp_path, end, encoding):
    rows = table(20)
    whole = write(tmp_path / "a.ply", rows, encoding).read_bytes()
    at = whole.index(b"end_header\n") + 11
    head, data = whole[:at].replace(b"\n", end.encode()), whole[at:]
    for first in (b"", b"\n", b"\r"):  # data that begins like an end of a line
        begun = data if encoding == "ascii" else first + data[len(first) :]
        body = begun.replace(b"\n", end.encode()) if encoding == "ascii" else begun
        (tmp_path / "b.ply").write_bytes(head + body)
        got = read(tmp_path / "b.ply")["position"]
        if encoding == "ascii" or not first:
            np.testing.assert_array_equal(got, np.stack([rows[c] for c in "xyz"], 1).astype(float))
        assert len(got) == 20 and not any("ignored" in w for w in open_scan(tmp_path / "b.ply").warnings)


def test_ply__comments_and_empty_lines_between_vertices_are_passed_over(tmp_path):
    text = (
        f"ply\nformat ascii 1.0\n\nelement vertex 3\n{XYZ}end_header\n\n0 0 0\ncomment here\n\n1 2 3\n# there\n4 5 6\n"
    )
    (tmp_path / "a.ply").write_text(text)
    assert read(tmp_path / "a.ply")["position"].tolist() == [[0, 0, 0], [1, 2, 3], [4, 5, 6]]


XYZ = "property float x\nproperty float y\nproperty float z\n"
HEADERS = {
    "no format": f"ply\nelement vertex 1\n{XYZ}end_header\n0 0 0\n",
    "unknown format": f"ply\nformat utf8 1.0\nelement vertex 1\n{XYZ}end_header\n0 0 0\n",
    "version": f"ply\nformat ascii 2.0\nelement vertex 1\n{XYZ}end_header\n0 0 0\n",
    "no vertices": f"ply\nformat ascii 1.0\nelement point 1\n{XYZ}end_header\n0 0 0\n",
    "vertices twice": f"ply\nformat ascii 1.0\nelement vertex 1\n{XYZ}element vertex 1\n{XYZ}end_header\n0 0 0\n",
    "no z": "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\n0 0 0\n",
    "x twice": f"ply\nformat ascii 1.0\nelement vertex 1\n{XYZ}property int x\nend_header\n0 0 0 0\n",
    "unknown type": "ply\nformat ascii 1.0\nelement vertex 1\nproperty half x\nend_header\n0\n",
    "property first": "ply\nformat ascii 1.0\nproperty float x\nend_header\n",
    "negative count": f"ply\nformat ascii 1.0\nelement vertex -1\n{XYZ}end_header\n0 0 0\n",
    "count is a word": f"ply\nformat ascii 1.0\nelement vertex many\n{XYZ}end_header\n0 0 0\n",
    "unknown keyword": f"ply\nformat ascii 1.0\nelephant\nelement vertex 1\n{XYZ}end_header\n0 0 0\n",
    "no end": f"ply\nformat ascii 1.0\nelement vertex 1\n{XYZ}",
    "endless": "ply\n" + "comment x\n" * (MAX_HEADER_BYTES // 8),
    "not a ply": "solid cube\n",
    "empty file": "",
    "mixed colours": f"ply\nformat ascii 1.0\nelement vertex 1\n{XYZ}property uchar red\nproperty float green\n"
    "property uchar blue\nend_header\n0 0 0 1 1 1\n",
    "no points": f"ply\nformat ascii 1.0\nelement vertex 0\n{XYZ}end_header\n",
}


@pytest.mark.parametrize("case", HEADERS)
def test_ply__refuses_a_broken_header(tmp_path, case):
    (tmp_path / "a.ply").write_text(HEADERS[case])
    with pytest.raises(InvalidScan, match="a.ply"):
        open_scan(tmp_path / "a.ply")


def test_ply__header_lines_may_end_as_on_windows(tmp_path):
    text = f"ply\nformat binary_little_endian 1.0\nelement vertex 1\n{XYZ}end_header\n".replace("\n", "\r\n")
    (tmp_path / "a.ply").write_bytes(text.encode() + struct.pack("<3f", 1, 2, 3))
    assert read(tmp_path / "a.ply")["position"].tolist() == [[1, 2, 3]]


def test_ply__trailing_bytes_are_warned_of(tmp_path):
    path = write(tmp_path / "a.ply", table(4))
    path.write_bytes(path.read_bytes() + b"??")
    assert "2 bytes after the last vertex" in open_scan(path).warnings[0]


def test_ply__reads_from_a_stream_that_is_no_file(tmp_path):
    rows = table(6)
    content = write(tmp_path / "a.ply", rows).read_bytes()
    vertices = open_vertices(lambda: nullcontext(io.BytesIO(content)), len(content), "stream")
    assert np.concatenate([p.position for p in vertices.pieces(4)])[:, 0].tolist() == rows["x"].tolist()


def test_ply__source_can_be_sent_to_another_process_and_read_twice(tmp_path):
    source = pickle.loads(pickle.dumps(open_scan(write(tmp_path / "a.ply", table(6)))))
    first, second = (np.concatenate([p.position for p in source.pieces(4)]) for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("with_color", [False, True])
def test_ply__open_reads_the_header_and_of_colours_a_few_runs(tmp_path, with_color):
    fields = FIELDS if with_color else [("x", "f4"), ("y", "f4"), ("z", "f4")]
    path = write(tmp_path / "a.ply", table(600_000, fields))
    n_read = 0

    class Counting(io.BytesIO):
        def read(self, n=-1):
            nonlocal n_read
            n_read += n if n >= 0 else 1 << 40
            return super().read(n)

    open_vertices(partial(Counting, path.read_bytes()), path.stat().st_size, "stream")
    assert n_read < (1 << 19 if with_color else 1 << 14)


@pytest.mark.parametrize(
    ("name", "n_points", "n_nan", "has_normals", "has_colors"),
    [
        ("stanford_bunny/bunny.ply", 35947, 0, False, False),
        ("stanford_dragon/dragon_points.ply", 437645, 0, True, False),
        ("organised_table_scene/scan.ply", 307200, 97920, False, True),
    ],
)
def test_ply__real_scans_have_the_known_counts(name, n_points, n_nan, has_normals, has_colors):
    source = open_scan(shared_scan(name))
    assert (source.n_points, source.has_normals, source.has_colors) == (n_points, has_normals, has_colors)
    pieces = [p.position for p in source.pieces(100_000)]
    assert sum(map(len, pieces)) == n_points
    assert sum(int(np.isnan(p).any(axis=1).sum()) for p in pieces) == n_nan


def test_ply__bunny_has_its_known_size_and_no_intensity_to_show():
    source = open_scan(shared_scan("stanford_bunny/bunny.ply"))
    pieces = list(source.pieces(50_000))
    position = np.concatenate([piece.position for piece in pieces])
    assert np.ptp(position, axis=0) == pytest.approx([0.156, 0.154, 0.121], abs=1e-3)
    assert not source.has_intensity and pieces[0].intensity is None
