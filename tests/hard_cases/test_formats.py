"""Files that nobody has seen here: each ends in finite output or in one clear error, and leaves nothing
half-written."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import laspy
import numpy as np
import pycolmap
import pye57
import pytest
from PIL import Image

from services.cli.main import main
from tests.hard_cases.scans import arrays_of_packed, write_points
from tests.pipeline.readers.workspace import centre_of, write_photo, write_ply, write_vis, write_workspace

UTM = np.array([4.5e5, 5.4e6, 100.0])
TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort", "i4": "int"}


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def sheet(n: int = 200) -> np.ndarray:
    return np.column_stack([rng().uniform(-1, 1, (n, 2)), 0.02 * rng().standard_normal(n)])


def xyz(points: np.ndarray, kind: str = "f4") -> dict[str, np.ndarray]:
    return {axis: points[:, i].astype(kind) for i, axis in enumerate("xyz")}


def colors(values: np.ndarray, kind: str) -> dict[str, np.ndarray]:
    return {channel: values.astype(kind) for channel in ("red", "green", "blue")}


def ply(
    folder: Path, columns: dict[str, np.ndarray], order: str = "<", first: tuple[list[str], bytes] = ([], b"")
) -> Path:
    """A binary PLY; `first` is an element that stands before the vertices, its header lines and its bytes."""
    rows = np.empty(len(columns["x"]), [(name, order + values.dtype.str[1:]) for name, values in columns.items()])
    for name, values in columns.items():
        rows[name] = values
    lines = [
        "ply",
        f"format binary_{'little' if order == '<' else 'big'}_endian 1.0",
        *first[0],
        f"element vertex {len(rows)}",
    ]
    lines += [f"property {TYPES[values.dtype.str[1:]]} {name}" for name, values in columns.items()] + ["end_header", ""]
    (folder / "scan.ply").write_bytes("\n".join(lines).encode() + first[1] + rows.tobytes())
    return folder / "scan.ply"


def las(folder: Path, points: np.ndarray, offset, point_format: int, suffix: str) -> Path:
    header = laspy.LasHeader(point_format=point_format, version="1.4")
    header.scales, header.offsets = np.full(3, 1e-7), np.asarray(offset, float)
    file = laspy.LasData(header)
    file.x, file.y, file.z = points.T
    file.red, file.green, file.blue = rng().integers(0, 65536, (3, len(points)))
    file.write(str(folder / f"scan{suffix}"))
    return folder / f"scan{suffix}"


def e57(folder: Path, *stations: dict, at: np.ndarray = UTM) -> Path:
    with pye57.E57(str(folder / "scan.e57"), mode="w") as file:
        for i, fields in enumerate(stations):
            file.write_scan_raw(
                {k: np.ascontiguousarray(v) for k, v in fields.items()}, name=f"{i}", translation=at + [i, 0, 0]
            )
    return folder / "scan.e57"


def cartesian(points: np.ndarray, **more) -> dict:
    return {f"cartesian{axis}": points[:, i] for i, axis in enumerate("XYZ")} | more


def workspace(folder: Path, **how) -> Path:
    return write_workspace(folder / "scan", **how).path


def with_points(folder: Path, points: np.ndarray, normal=(0, 0, -1.0), seen: bool = True) -> Path:
    scan = workspace(folder)
    normals = np.broadcast_to(np.float32(normal), points.shape)
    write_ply(scan / "fused.ply", points.astype(np.float32), normals, np.full(points.shape, 128, np.uint8))
    write_vis(scan / "fused.ply.vis", ((0, 1, 2) if seen else (),) * len(points))
    return scan


def renamed(folder: Path, names: list[str], ending: str) -> Path:
    scan = workspace(folder, n_cameras=len(names))
    model = pycolmap.Reconstruction(str(scan / "sparse"))
    for image, name in zip((model.images[i] for i in sorted(model.images)), names, strict=True):
        (scan / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        (scan / "images" / image.name).rename(scan / "images" / name)
        image.name = name
    for file in (scan / "sparse").iterdir():
        file.unlink()
    (model.write_binary if ending == ".bin" else model.write_text)(str(scan / "sparse"))
    return scan


def photos_as(folder: Path, mode: str, suffix: str = ".jpg", turned: bool = False) -> Path:
    scan = workspace(folder, photo_suffix=suffix)
    for file in (scan / "images").iterdir():
        photo = Image.open(file).convert(mode)
        exif = photo.getexif()
        if turned:
            exif[274] = 6  # orientation: to be turned by a quarter
        photo.save(file, exif=exif)
    return scan


def photos_of(folder: Path, photo: np.ndarray, sample: str = "uint8", only: str = "") -> Path:
    scan = workspace(folder)
    for file in (scan / "images").glob(f"*{only}.png"):
        write_photo(file, photo, sample)
    return scan


def without(folder: Path, name: str) -> Path:
    (workspace(folder) / name).unlink()
    return folder / "scan"


FACES = ["element face 3", "property list uchar int vertex_indices"], struct.pack("<Biii", 3, 0, 1, 2) * 3
NAMES = ["left/my photo 1.png", "Föto 点.png", "right/deep er/é.png"]
GREY = rng().integers(0, 65536, (48, 64, 1)).astype(np.uint16)

CASES = {  # name: what makes it, exit code of compress
    "ply of doubles at UTM": (lambda f: ply(f, xyz(20 * sheet() + UTM, "f8")), 0),
    "big-endian ply": (lambda f: ply(f, xyz(sheet()) | colors(rng().integers(0, 256, 200), "u1"), ">"), 0),
    "ply with lists first": (lambda f: ply(f, xyz(sheet()), first=FACES), 0),
    "16-bit colours": (lambda f: ply(f, xyz(sheet()) | colors(rng().integers(0, 65536, 200), "u2")), 0),
    "float colours to 1": (lambda f: ply(f, xyz(sheet()) | colors(np.linspace(0, 1.0000001, 200), "f4")), 0),
    "float colours to 255": (lambda f: ply(f, xyz(sheet()) | colors(np.linspace(0, 255, 200), "f4")), 0),
    "colours of NaN": (lambda f: ply(f, xyz(sheet()) | colors(np.where(np.arange(200) < 9, np.nan, 0.5), "f4")), 0),
    "colours of infinity": (
        lambda f: ply(f, xyz(sheet()) | colors(np.where(np.arange(200) < 9, np.inf, 0.5), "f4")),
        0,
    ),
    "normals of 0": (lambda f: ply(f, xyz(sheet()) | {a: np.zeros(200, "f4") for a in ("nx", "ny", "nz")}), 0),
    "normals of 3e38": (lambda f: ply(f, xyz(sheet()) | {a: np.full(200, 3e38, "f4") for a in ("nx", "ny", "nz")}), 0),
    "normals of 1e-44": (
        lambda f: ply(f, xyz(sheet()) | {a: np.full(200, 1e-44, "f4") for a in ("nx", "ny", "nz")}),
        0,
    ),
    "one point": (lambda f: ply(f, xyz(sheet(1))), 3),
    "four points": (lambda f: ply(f, xyz(sheet(4))), 3),
    "points that are equal": (lambda f: ply(f, xyz(np.ones((300, 3)))), 3),
    "points of 1e-15": (lambda f: ply(f, xyz(1e-15 * sheet(), "f8")), 3),
    "a line of points": (lambda f: ply(f, xyz(np.outer(np.linspace(0, 1, 300), [1, 2, 3]))), 0),
    **{f"{n} points": (lambda f, n=n: ply(f, xyz(sheet(n))), 0) for n in (128, 129, 8192, 8193)},
    "las 1.4 of format 7 at 5e9": (lambda f: las(f, sheet() + 1e4 * UTM, 1e4 * UTM, 7, ".las"), 0),
    "laz 1.4 of format 8": (lambda f: las(f, sheet() + UTM, UTM, 8, ".laz"), 0),
    "e57 of two stations": (lambda f: e57(f, cartesian(sheet()), cartesian(sheet())), 0),
    "e57 of invalid points": (
        lambda f: e57(f, cartesian(sheet(), cartesianInvalidState=(np.arange(200) % 2 * 2).astype(np.int8))),
        0,
    ),
    "fisheye cameras in text": (
        lambda f: workspace(f, model="OPENCV_FISHEYE", params=(60, 60, 32, 24, 0.01, 0.001, 0, 0), ending=".txt"),
        0,
    ),
    "distorted cameras": (lambda f: workspace(f, model="OPENCV", params=(60, 60, 32, 24, 0.1, 0.01, 1e-3, 1e-3)), 0),
    "wild distortion": (lambda f: workspace(f, model="RADIAL", params=(60, 32, 24, 5.0, -9.0)), 0),
    "names of all kinds": (lambda f: renamed(f, NAMES, ".bin"), 0),
    "names of all kinds in text": (lambda f: renamed(f, NAMES, ".txt"), 0),
    "a missing photograph": (lambda f: without(f, "images/0001.png"), 0),
    "a photograph of another size": (lambda f: photos_of(f, np.zeros((24, 32, 3), np.uint8), only="1"), 0),
    "grey photographs of 16 bits": (lambda f: photos_of(f, GREY, "uint16"), 0),
    "photographs in CMYK": (lambda f: photos_as(f, "CMYK"), 0),
    "photographs that say they lie": (lambda f: photos_as(f, "RGB", turned=True), 0),
    "photographs of one colour": (lambda f: photos_of(f, np.full((48, 64, 3), 77, np.uint8)), 0),
    "black photographs": (lambda f: photos_of(f, np.zeros((48, 64, 3), np.uint8)), 0),
    "no visibility": (lambda f: without(f, "fused.ply.vis"), 0),
    "one camera": (lambda f: workspace(f, n_cameras=1), 0),
    "nothing seen": (lambda f: with_points(f, sheet(), seen=False), 0),
    "all behind the cameras": (lambda f: with_points(f, sheet() - [0, 0, 10]), 0),
    "all turned away": (lambda f: with_points(f, sheet(), (0, 0, 1.0)), 0),
    "all around the cameras": (lambda f: with_points(f, rng().standard_normal((300, 3)) + centre_of(1, 3)), 0),
    "points at the cameras": (
        lambda f: with_points(f, np.concatenate([sheet(), [centre_of(i, 3) for i in range(3)]])),
        0,
    ),
    "points of NaN": (lambda f: with_points(f, np.where(rng().random((200, 1)) < 0.2, np.nan, sheet())), 0),
    "a photographed point": (lambda f: with_points(f, np.zeros((1, 3))), 3),
}


@pytest.mark.parametrize("case", CASES)
def test_formats__end_in_finite_output_or_one_clear_error(tmp_path, capsys, case):
    make, code = CASES[case]
    scan, out = make(tmp_path), tmp_path / "out"
    capsys.readouterr()
    checked = main(["check", str(scan)])
    found = capsys.readouterr().out
    assert (
        main(["compress", str(scan), "--out", str(out), "--preset", "draft", "--executor", "serial", "--no-render"])
        == code
    )
    err = capsys.readouterr().err
    assert checked in (0, code) and "Traceback" not in err
    if code:
        assert not out.exists() and sum("splatpress: data error: " in line for line in err.splitlines()) == 1
        assert found or checked == 5, "check has nothing to say of what compress refuses"
        return
    report = json.loads((out / "report.json").read_text())
    json.dumps(report, allow_nan=False)
    assert all(
        np.isfinite(a).all() for a in arrays_of_packed(next(out.glob("*.splatpress"))).values() if a.dtype.kind == "f"
    )
    assert report["splats"] + report["numerics"]["dropped_points"] == report["scan"]["n_points"]


def test_formats__a_normal_of_zero_is_that_of_its_neighbours(tmp_path, capsys):
    """Naive: +z, whichever way the surface lies."""
    position = np.column_stack([np.zeros(400), rng().uniform(-1, 1, (400, 2))])
    normal = np.tile(np.float32([1, 0, 0]), (400, 1))
    normal[::7] = 0
    scan = write_points(tmp_path / "wall.ply", position, normal)
    assert main(["compress", str(scan), "--out", str(tmp_path / "out"), "--executor", "serial", "--no-render"]) == 0
    assert np.array_equal(
        np.abs(arrays_of_packed(tmp_path / "out" / "wall.splatpress")["normal"]), np.tile([127, 0], (400, 1))
    )
    numerics = json.loads((tmp_path / "out" / "report.json").read_text())["numerics"]
    assert numerics["degenerate_normals"] == 0


def test_formats__photographs_of_one_colour_are_kept_exactly_and_the_words_say_so(tmp_path, capsys):
    """In whole bytes; in boxes, points that no photograph shows have colours of their own, and cells are as wide as
    they ask."""
    scan = photos_of(tmp_path, np.full((48, 64, 3), 77, np.uint8))
    assert (
        main(
            [
                "compress",
                str(scan),
                "--out",
                str(tmp_path / "out"),
                "--preset",
                "draft",
                "--coder",
                "paper",
                "--executor",
                "serial",
                "--no-render",
            ]
        )
        == 0
    )
    assert "resampling identical" in capsys.readouterr().out
    quality = json.loads((tmp_path / "out" / "report.json").read_text())["quality"]
    assert quality["texture_psnr_db"] == quality["resampling_psnr_db"] == 100.0
