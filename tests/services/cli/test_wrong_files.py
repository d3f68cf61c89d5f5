"""Files that are no scan, or a broken one: one line that names the file and what is wrong, the exit code that README
promises, and nothing left behind; before workers start, so that the default executor costs nothing."""

import io
import struct
import zipfile
from pathlib import Path

import laspy
import numpy as np
import pytest

from services.cli.main import main
from tests.services.scans import photo_scan

HEADER = b"ply\nformat binary_little_endian 1.0\n"
XYZ = b"property float x\nproperty float y\nproperty float z\nend_header\n"


def las(n: int = 40) -> bytes:
    made = laspy.LasData(laspy.LasHeader(point_format=0, version="1.2"))
    made.x, made.y, made.z = np.random.default_rng(0).uniform(size=(3, n))
    out = io.BytesIO()
    made.write(out)
    return out.getvalue()


def zipped(**files: bytes) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return out.getvalue()


FILES = [  # name, bytes, exit code, words of its line
    ("empty.ply", b"", 3, "empty"),
    ("picture.ply", b"\x89PNG\r\n\x1a\n" + bytes(99), 3, "picture.ply"),
    ("cut.ply", HEADER + b"element vertex 9\n" + XYZ + bytes(20), 3, "cut.ply"),
    ("endless.ply", HEADER + b"element vertex 9\n" + b"comment long\n" * 50, 3, "end_header"),
    ("noun.ply", HEADER + b"element vertex 9\nproperty noun x\n" + XYZ, 3, "noun"),
    ("faces.ply", HEADER + b"element face 1\nproperty list uchar int vertex_indices\nend_header\n", 3, "vertex"),
    ("flat.ply", HEADER + b"element vertex 2\nproperty float x\nproperty float y\nend_header\n" + bytes(16), 3, "z"),
    ("letters.las", b"this is no LAS file" * 20, 3, "LASF"),
    ("cut.las", las()[:300], 3, "cut.las"),
    ("half.las", las()[:-100], 3, "half.las"),
    ("letters.laz", b"LASF" + bytes(400), 5, "letters.laz"),
    ("letters.e57", b"no E57 at all, but long enough for a header" * 9, 3, "letters.e57"),
    ("page.e57", b"ASTM-E57" + struct.pack("<IIQQQQ", 1, 0, 1 << 40, 48, 9, 1024) + bytes(2000), 3, "page.e57"),
    ("columns.ptx", b"12\nmany\n" + b"0 0 0\n" * 9, 3, "columns.ptx"),
    ("words.xyz", b"these are\nno numbers\nat all\n", 3, "words.xyz"),
    ("fields.pcd", b"VERSION 0.7\nSIZE 4 4 4\nDATA ascii\n", 3, "fields.pcd"),
    ("none.zip", b"PK no archive", 3, "none.zip"),
    ("model.zip", zipped(**{"images/a.jpg": b"x"}), 3, "model.zip"),
    (
        "voxels.nrrd",
        b"NRRD0004\ntype: uint8\ndimension: 3\nsizes: 9 9 9\nencoding: raw\n\n" + bytes(9),
        3,
        "voxels.nrrd",
    ),
    ("letters.nii", b"no NIfTI" * 90, 3, "letters.nii"),
    ("letters.tif", b"II*\0" + bytes(90), 3, "letters.tif"),
    ("table.xlsx", b"PK\3\4" + bytes(90), 5, "table.xlsx"),
    ("notes.doc", b"notes", 5, "notes.doc"),
]


@pytest.mark.parametrize(("name", "data", "code", "words"), FILES, ids=[name for name, *_ in FILES])
def test_cli__a_wrong_file_is_refused_in_one_line(tmp_path, capsys, name, data, code, words):
    (tmp_path / name).write_bytes(data)
    found = main(["compress", str(tmp_path / name), "--no-render", "--out", str(tmp_path / "out")])
    out, said = capsys.readouterr()
    assert (found, len(said.splitlines()), out) == (code, 1, ""), said
    assert words in said and name in said and said.startswith("splatpress: data error: ")
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_cli__folders_that_are_no_workspace_are_refused_in_one_line(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    scan = photo_scan(tmp_path / "scan", n_side=8)
    (scan / "fused.ply").unlink()
    for folder in (tmp_path / "empty", scan):
        assert main(["compress", str(folder), "--no-render", "--out", str(tmp_path / "out")]) in (3, 5)
        said = capsys.readouterr().err
        assert len(said.splitlines()) == 1 and folder.name in said and not (tmp_path / "out").exists()


GOLDEN = (Path(__file__).parents[2] / "golden" / "quadrics.splatpress").read_bytes()
FLIPPED = GOLDEN[:9000] + bytes([GOLDEN[9000] ^ 1]) + GOLDEN[9001:]
BROKEN = [  # name, bytes or None for a folder, words of its line
    ("empty.splatpress", b"", "an empty file"),
    ("half.splatpress", GOLDEN[: len(GOLDEN) // 2], "cut off or altered"),
    ("flipped.splatpress", FLIPPED, "altered"),
    ("seal.splatpress", GOLDEN[:-70] + b"X" + GOLDEN[-69:], "no seal"),
    ("picture.splatpress", b"\xff\xd8\xff\xe0" + bytes(999), "no packed file"),
    ("folder.splatpress", None, "a folder"),
]
READING = [  # of a packed file PACKED
    ["inspect"],
    ["coverage"],
    ["view", "--no-open"],
    ["render", "--orbit", "1", "--out", "OUT"],
    ["report", "--scan", "PACKED", "--out", "OUT"],
    ["export", "--to", "ply", "--out", "OUT"],
    ["export", "--to", "archive", "--out", "OUT"],
    ["path", "record", "--out", "OUT"],
    ["fly", "--path", "PATH", "--out", "OUT"],
    ["fly", "--table"],
]


@pytest.mark.parametrize(("name", "data", "words"), BROKEN, ids=[name for name, *_ in BROKEN])
def test_cli__every_command_refuses_a_broken_packed_file_in_the_same_line(tmp_path, capsys, name, data, words):
    packed = tmp_path / name
    packed.mkdir() if data is None else packed.write_bytes(data)
    said = set()
    for verb, *rest in READING:
        first = [rest.pop(0)] if verb == "path" else []
        where = {"PACKED": str(packed), "OUT": str(tmp_path / "out"), "PATH": str(tmp_path / "path.json")}
        assert main([verb, *first, str(packed), *(where.get(word, word) for word in rest)]) == 3, verb
        out, line = capsys.readouterr()
        assert (out, len(line.splitlines())) == ("", 1), verb
        said.add(line)
    assert len(said) == 1 and words in (line := said.pop()), said
    assert line.startswith(f"splatpress: data error: {packed}: ")
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("data", [GOLDEN, FLIPPED], ids=["whole", "altered"])
def test_cli__a_packed_file_is_no_scan(tmp_path, capsys, data):
    packed = tmp_path / "a.splatpress"
    packed.write_bytes(data)
    for arguments in (["compress", "--no-render", "--out", str(tmp_path / "o")], ["check"]):
        assert main([arguments[0], str(packed), *arguments[1:]]) == 5
        said = capsys.readouterr().err
        assert len(said.splitlines()) == 1 and "a packed file is no scan" in said
