"""E57: stations and poses, coordinates, limits, images, on files written here and on the real scan."""

import json
import os
import pickle
import re

import numpy as np
import pye57
import pytest
from pye57 import libe57

from pipeline.cameras.pinhole import Pinhole
from pipeline.readers import inspect_scan, open_scan
from pipeline.readers.attributes.marks import NUMBER
from pipeline.readers.e57 import e57
from pipeline.readers.e57.nodes import rotation_matrix
from pipeline.readers.e57.panoramas import Panorama, parts_of, share_left_out
from storage.errors import InvalidScan, UnsupportedScan
from tests.pipeline.readers.shared_data import shared_scan
from tests.pipeline.readers.workspace import texture, write_photo

PUMP = "pump_e57/pumpAVisualReferenceImage.e57"
TURNED = (0.5, 0.5, 0.5, 0.5)  # x -> y -> z -> x
CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
COLOR = ("colorRed", "colorGreen", "colorBlue")


def structure(file, **children):
    """A structure node: floats, ints and strings become nodes, dicts structures."""
    node = libe57.StructureNode(file)
    kinds = {float: libe57.FloatNode, int: libe57.IntegerNode, str: libe57.StringNode}
    for name, value in children.items():
        made = structure(file, **value) if isinstance(value, dict) else value
        node.set(name, kinds[type(made)](file, made) if type(made) in kinds else made)
    return node


def pose_of(rotation, translation):
    rotation, translation = map(float, rotation), map(float, translation)
    return {"rotation": dict(zip("wxyz", rotation)), "translation": dict(zip("xyz", translation))}


def prototype(file, columns):
    node = libe57.StructureNode(file)
    for name, values in columns.items():
        if np.asarray(values).dtype.kind == "f":
            node.set(name, libe57.FloatNode(file, 0.0, libe57.E57_DOUBLE))
        else:
            node.set(name, libe57.IntegerNode(file, 0, 0, 65535))
    return node


def add_scan(file, data3d, columns, **children):
    """One entry of data3D; columns map field names to arrays."""
    scan = structure(file, guid="{0}", **children)
    points = libe57.CompressedVectorNode(file, prototype(file, columns), libe57.VectorNode(file, True))
    scan.set("points", points)
    data3d.append(scan)
    n = len(next(iter(columns.values())))
    arrays = {name: np.ascontiguousarray(values, np.float64) for name, values in columns.items()}
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in arrays.items():
        buffers.append(libe57.SourceDestBuffer(file, name, array, max(1, n), True, True))
    if n:
        writer = points.writer(buffers)
        writer.write(n)
        writer.close()


def add_image(file, images, photo=None, pose=None, key="jpegImage", kind="pinholeRepresentation", **pinhole):
    image = structure(file, guid="{1}", name="front", **({"pose": pose} if pose else {}))
    numbers = {"imageWidth": 64, "imageHeight": 48, "focalLength": 0.03, "pixelWidth": 0.0005, "pixelHeight": 0.0005}
    representation = structure(file, **{**numbers, "principalPointX": 32.0, "principalPointY": 24.0, **pinhole})
    image.set(kind, representation)
    images.append(image)
    if photo is not None:
        content = np.fromfile(photo, np.uint8)
        blob = libe57.BlobNode(file, len(content))
        representation.set(key, blob)
        blob.write(content, 0, len(content))


def write(path, *scans, images=()):
    """Scans are dicts of columns with an optional "pose" and others; images are keyword dicts of add_image."""
    e57 = pye57.E57(str(path), mode="w")
    for scan in scans:
        columns = {k: v for k, v in scan.items() if isinstance(v, np.ndarray)}
        others = {k: v for k, v in scan.items() if k not in columns}
        add_scan(e57.image_file, e57.data3d, columns, **others)
    for image in images:
        add_image(e57.image_file, e57.root["images2D"], **image)
    e57.close()
    return path


def cartesian(n=50, seed=0):
    return dict(zip(CARTESIAN, np.random.default_rng(seed).uniform(-5, 5, (3, n)), strict=True))


def gather(source, max_points=20):
    pieces = list(source.pieces(max_points))
    columns = {k: [getattr(p, k) for p in pieces] for k in ("position", "color", "intensity", "station")}
    return {k: None if v[0] is None else np.concatenate(v) for k, v in columns.items()}


def stacked(scan):
    return np.stack([scan[c] for c in CARTESIAN], axis=1)


def test_e57__quaternions_turn_as_pye57_has_it():
    from pyquaternion import Quaternion

    for q in np.random.default_rng(0).normal(size=(20, 4)):
        np.testing.assert_allclose(rotation_matrix(*(3 * q)), Quaternion(q).unit.rotation_matrix, atol=1e-14)


def test_e57__stations_have_their_poses_applied(tmp_path):
    here, there = cartesian(30), cartesian(50, seed=1)
    there["pose"] = pose_of(TURNED, (4_500_000.25, 10, -3))
    source = open_scan(write(tmp_path / "a.e57", here, there))
    got = gather(source)
    expected = np.concatenate([stacked(here), stacked(there)[:, [2, 0, 1]] + [4_500_000.25, 10, -3]])
    np.testing.assert_allclose(got["position"], expected, rtol=0, atol=1e-8)
    assert got["station"].tolist() == [-1] * 30 + [0] * 50  # without a pose nobody knows where the scanner stood
    assert source.stations == ((4_500_000.25, 10, -3),) and source.unit == "metre"


def test_e57__piece_size_changes_nothing_and_is_never_exceeded(tmp_path):
    source = open_scan(write(tmp_path / "a.e57", cartesian(30), cartesian(50, seed=1)))
    whole = gather(source, 1000)
    for n in (1, 7, 30, 80):
        assert max(len(p.position) for p in source.pieces(n)) <= n
        np.testing.assert_array_equal(gather(source, n)["position"], whole["position"])


def test_e57__a_small_file_is_taken_apart_once_and_again_when_it_changed(tmp_path, monkeypatch):
    path = write(tmp_path / "a.e57", cartesian(50), cartesian(30, seed=1))
    read, station_rows = [], e57.station_rows
    monkeypatch.setattr(e57, "station_rows", lambda *asked: read.append(asked) or station_rows(*asked))
    source = e57.open_e57(str(path))
    kept, n_read = gather(source), len(read)
    again = gather(source)
    assert (n_read, len(read)) == (0, 2)
    np.testing.assert_array_equal(kept["position"], again["position"])
    source = e57.open_e57(str(path))
    os.utime(path, ns=(0, 0))
    gather(source)
    assert len(read) == 4


def test_e57__spherical_coordinates_become_cartesian(tmp_path):
    radius, azimuth, elevation = np.array([2.0, 2.0, 2.0]), np.array([0, np.pi / 2, 0.0]), np.array([0, 0, np.pi / 2])
    source = open_scan(write(tmp_path / "a.e57", dict(zip(SPHERICAL, (radius, azimuth, elevation), strict=True))))
    np.testing.assert_allclose(gather(source)["position"], [[2, 0, 0], [0, 2, 0], [0, 0, 2]], atol=1e-12)


@pytest.mark.parametrize("fields", [CARTESIAN, SPHERICAL])
def test_e57__invalid_points_are_marked_and_still_counted(tmp_path, fields):
    state = "cartesianInvalidState" if fields is CARTESIAN else "sphericalInvalidState"
    scan = dict(zip(fields, np.ones((3, 4)), strict=True)) | {state: np.array([0, 1, 2, 0])}
    source = open_scan(write(tmp_path / "a.e57", scan))
    mark = np.concatenate([p.mark for p in source.pieces(20)])
    assert source.n_points == len(mark) == 4
    assert mark.tolist() == [0, NUMBER["invalid"], NUMBER["invalid"], 0]


def test_e57__colours_are_scaled_by_their_limits(tmp_path):
    limits = {f"{c}{end}": value for c in COLOR for end, value in (("Minimum", 0), ("Maximum", 1000))}
    scan = cartesian(3) | {c: np.array([0, 500, 1000]) for c in COLOR}
    source = open_scan(write(tmp_path / "a.e57", scan | {"colorLimits": limits}))
    assert gather(source)["color"][:, 0].tolist() == [0, 128, 255]


def test_e57__colours_without_limits_are_scaled_by_the_range_of_the_field(tmp_path):
    scan = cartesian(3) | {c: np.array([0, 257, 65535]) for c in COLOR}
    assert gather(open_scan(write(tmp_path / "a.e57", scan)))["color"][:, 2].tolist() == [0, 1, 255]


@pytest.mark.parametrize("top", [1.0, 255.0, 4095.0, 65535.0])
def test_e57__colours_without_any_range_are_told_from_their_values(tmp_path, top):
    scan = cartesian(300) | {c: np.linspace(0, top, 300) for c in COLOR}
    source = open_scan(write(tmp_path / "a.e57", scan))
    np.testing.assert_allclose(gather(source)["color"][:, 1], np.linspace(0, 255, 300), atol=0.51)
    assert "taken as" in " ".join(source.warnings)


def test_e57__intensity_has_its_declared_range_and_is_marked_where_invalid(tmp_path):
    scan = cartesian(3) | {"intensity": np.array([0.25, 0.5, 2.0]), "isIntensityInvalid": np.array([0, 1, 0])}
    scan["intensityLimits"] = {"intensityMinimum": 0.0, "intensityMaximum": 2.0}
    source = open_scan(write(tmp_path / "a.e57", scan))
    assert source.intensity_range == (0, 2)
    np.testing.assert_array_equal(gather(source)["intensity"], np.float32([0.25, 0.5, 2]))
    assert np.concatenate([p.mark for p in source.pieces(20)]).tolist() == [0, NUMBER["no-intensity"], 0]


def test_e57__a_station_without_colours_is_named(tmp_path):
    colored = cartesian(3) | {c: np.array([0, 1, 2]) for c in COLOR} | {"name": "one"}
    colored["colorLimits"] = {f"{c}{end}": value for c in COLOR for end, value in (("Minimum", 0), ("Maximum", 255))}
    source = open_scan(write(tmp_path / "a.e57", colored, cartesian(3) | {"name": "two"}))
    assert source.has_colors and "['two'] have no colours" in " ".join(source.warnings)
    assert gather(source)["color"][:, 0].tolist() == [0, 1, 2, 128, 128, 128]


def test_e57__refuses_a_quaternion_of_length_0(tmp_path):
    with pytest.raises(InvalidScan, match=r"data3D\[0\].pose.rotation: \[0.0, 0.0, 0.0, 0.0\]"):
        open_scan(write(tmp_path / "a.e57", cartesian() | {"pose": pose_of((0, 0, 0, 0), (0, 0, 0))}))


def test_e57__refuses_a_node_of_another_kind_than_the_standard_has(tmp_path):
    with pytest.raises(InvalidScan, match="a.e57"):
        open_scan(write(tmp_path / "a.e57", cartesian() | {"pose": "here"}))


def test_e57__refuses_points_without_coordinates(tmp_path):
    with pytest.raises(UnsupportedScan, match="cartesianX"):
        open_scan(write(tmp_path / "a.e57", {"intensity": np.ones(3)}))


def test_e57__refuses_a_file_without_points(tmp_path):
    with pytest.raises(InvalidScan, match="0 points"):
        open_scan(write(tmp_path / "a.e57"))


def test_e57__refuses_every_truncation_and_altered_pages(tmp_path):
    whole = write(tmp_path / "a.e57", cartesian(500)).read_bytes()
    cut = tmp_path / "cut.e57"
    for n in [*range(0, len(whole), 301), len(whole) - 1]:
        cut.write_bytes(whole[:n])
        with pytest.raises(InvalidScan, match="cut.e57"):
            open_scan(cut)
    for at in range(40, len(whole), 997):
        cut.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        with pytest.raises(InvalidScan, match="cut.e57"):
            gather(open_scan(cut))


# --- images ---

CENTRE = np.array([0.2, -0.1, 3.0])
LOOKING_DOWN = (1.0, 0.0, 0.0, 0.0)  # E57 cameras look along -z with y up


def photo_of_floor(path):
    """The floor z = 0 with its texture from CENTRE, x to the right and y up in the picture."""
    u, v = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    x = CENTRE[0] + (u - 32) / 60 * CENTRE[2]
    y = CENTRE[1] - (v - 24) / 60 * CENTRE[2]
    write_photo(path, texture(x, y))
    return path


def floor_scan():
    x, y = np.random.default_rng(0).uniform(-0.8, 0.8, (2, 200))
    return dict(zip(CARTESIAN, (x, y, np.zeros(200)), strict=True))


@pytest.mark.parametrize("turn", [False, True])
def test_e57__pinhole_images_become_cameras_that_see_the_points_in_their_colours(tmp_path, turn):
    photo = photo_of_floor(tmp_path / "p.png")
    world = rotation_matrix(*TURNED) if turn else np.eye(3)  # turns the floor and the camera together
    pose = pose_of(TURNED if turn else LOOKING_DOWN, world @ CENTRE)
    scan = floor_scan() | ({"pose": pose_of(TURNED, (0, 0, 0))} if turn else {})
    source = open_scan(write(tmp_path / "a.e57", scan, images=[{"photo": photo, "pose": pose, "key": "pngImage"}]))
    (camera,) = source.cameras
    assert (camera.name, camera.width_px, camera.height_px, source.warnings) == ("front", 64, 48, ())
    position = gather(source)["position"]
    local = (position - camera.centre) @ np.array(camera.rotation).T
    assert (local[:, 2] > 0).all()
    focal, centre = (camera.fx_px, camera.fy_px), (camera.cx_px, camera.cy_px)
    pixel = np.floor(local[:, :2] / local[:, 2:] * focal + centre).astype(int)
    inside = ((pixel >= 0) & (pixel < [64, 48])).all(axis=1)
    assert inside.sum() > 100
    pixels = source.read_photo(0)[pixel[inside, 1], pixel[inside, 0]].astype(int)
    floor = floor_scan()
    truth = texture(floor["cartesianX"], floor["cartesianY"])[inside]
    assert np.abs(pixels - truth).max() < 16  # within half a pixel of the truth


def hue(direction):
    """A colour (n, 3) of each unit direction in a panorama's own frame, that no turn or mirror image of it has."""
    return np.clip(128 + 100 * direction @ np.array([[0.9, 0.1, 0], [0, 0.8, -0.3], [0.2, 0, 0.9]]), 0, 255)


def panorama(path, width, height, span, rise):
    """A picture of `hue`, `span` radians around; `rise(row)` the elevation of a row. Azimuth grows to the left."""
    azimuth = (width / 2 - np.arange(width) - 0.5) * span / width
    azimuth, elevation = np.meshgrid(azimuth, rise(np.arange(height) + 0.5))
    flat = np.cos(elevation)
    direction = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
    write_photo(path, hue(direction.reshape(-1, 3)).reshape(height, width, 3).round().astype(np.uint8))
    return {"photo": path, "key": "pngImage", "imageWidth": width, "imageHeight": height, "pixelWidth": span / width}


@pytest.mark.parametrize("kind", ["whole", "in metres", "a third", "cylinder"])
def test_e57__panoramas_become_photographs_that_see_the_points_in_their_colours(tmp_path, kind):
    path = tmp_path / "p.png"
    if kind == "cylinder":
        image = panorama(path, 256, 64, 2 * np.pi, lambda row: np.arctan((40 - row) * 0.02))
        image |= {"kind": "cylindricalRepresentation", "principalPointY": 40.0, "pixelHeight": 0.01, "radius": 0.5}
    else:
        span, height = (2 * np.pi / 3, 100) if kind == "a third" else (2 * np.pi, 128)
        pixel = 0.01 if kind == "a third" else np.pi / 128
        image = panorama(path, 256, height, span, lambda row: (height / 2 - row) * pixel)
        image |= {"kind": "sphericalRepresentation", "pixelHeight": pixel}
        image |= {"pixelWidth": 5e-6, "pixelHeight": 5e-6} if kind == "in metres" else {}
    rotation, centre = rotation_matrix(*TURNED), np.array([3.0, -2.0, 1.0])
    direction = np.random.default_rng(1).normal(size=(500, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = dict(zip(CARTESIAN, (4 * direction @ rotation.T + centre).T, strict=True))
    source = open_scan(write(tmp_path / "a.e57", points, images=[image | {"pose": pose_of(TURNED, centre)}]))
    seen = np.zeros(500, int)
    for i, camera in enumerate(source.cameras):
        picture = source.read_photo(i).astype(int)
        assert picture.shape == (camera.height_px, camera.width_px, 3)
        pixel, depth = Pinhole(camera).project(gather(source)["position"])
        inside = (depth > 0) & (pixel >= 0).all(axis=1) & (pixel < [camera.width_px, camera.height_px]).all(axis=1)
        column, row = pixel[inside].astype(int).T
        assert np.abs(picture[row, column] - hue(direction[inside])).max() <= 5  # half a pixel is 3
        seen += inside
    azimuth, elevation = np.arctan2(direction[:, 1], direction[:, 0]), np.arcsin(direction[:, 2])
    shown = {
        "a third": (np.abs(azimuth) < 1.02) & (np.abs(elevation) < 0.44),
        "cylinder": np.tan(np.abs(elevation)) < 0.42,
    }
    assert (seen[shown.get(kind, slice(None))] > 0).all()
    assert len(source.cameras) == {"a third": 3, "cylinder": 8}.get(kind, 6)
    *told, of_azimuth = source.warnings
    assert "azimuths of spherical and cylindrical images are taken as the standard has them" in of_azimuth
    wanted = {"in metres": "taken for the whole sphere", "whole": None}.get(
        kind, "% of its pixels are not used: corners of its"
    )
    assert len(told) == (wanted is not None) and (not told or wanted in told[0])


def test_e57__images_that_cannot_be_cameras_are_named_with_the_reason(tmp_path):
    photo, pose = photo_of_floor(tmp_path / "p.jpg"), pose_of(LOOKING_DOWN, CENTRE)
    images = [
        {"photo": photo, "pose": pose, "kind": "visualReferenceRepresentation"},
        {"photo": photo},
        {"pose": pose},
        {"photo": photo, "pose": pose},
    ]
    source = open_scan(write(tmp_path / "a.e57", cartesian(), images=images))
    reasons = ["images2D[0] 'front' is not used: its representation is visualReference"]
    reasons += ["[1] 'front' is not used: it has no pose"]
    reasons += ["holds neither a JPEG nor a PNG"]
    for reason, warning in zip(reasons, source.warnings, strict=True):
        assert reason in warning
    assert len(source.cameras) == 1 and source.read_photo(0).shape == (48, 64, 3)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"imageWidth": 65}, "a photo of 64x48 pixels, declared as 65x48"),
        ({"imageWidth": 0}, "a size of 0x48"),
        ({"focalLength": -0.03}, "focalLength"),
        ({"pixelWidth": 0.0}, "pixelWidth"),
        ({"kind": "sphericalRepresentation", "pixelWidth": 0.2}, "pixels that span 12.8 radians around"),
        ({"kind": "cylindricalRepresentation", "radius": 0.0}, "radius"),
    ],
)
def test_e57__refuses_a_wrong_pinhole_naming_image_and_value(tmp_path, wrong, message):
    image = {"photo": photo_of_floor(tmp_path / "p.jpg"), "pose": pose_of(LOOKING_DOWN, CENTRE), **wrong}
    with pytest.raises(InvalidScan, match=r"images2D\[0\]") as error:
        open_scan(write(tmp_path / "a.e57", cartesian(), images=[image]))
    assert message in str(error.value)


def test_e57__source_can_be_sent_to_another_process(tmp_path):
    image = {"photo": photo_of_floor(tmp_path / "p.jpg"), "pose": pose_of(LOOKING_DOWN, CENTRE)}
    source = open_scan(write(tmp_path / "a.e57", cartesian(), images=[image]))
    other = pickle.loads(pickle.dumps(source))
    np.testing.assert_array_equal(gather(source)["position"], gather(other)["position"])
    np.testing.assert_array_equal(source.read_photo(0), other.read_photo(0))


# --- the real scan ---


def test_e57__pump_in_pieces_is_what_pye57_reads_at_once():
    path = shared_scan(PUMP)
    source = open_scan(path)
    got = gather(source, 40_000)
    whole = pye57.E57(str(path)).read_scan(0, intensity=True, colors=True)
    np.testing.assert_array_equal(got["position"], stacked(whole))
    np.testing.assert_array_equal(got["color"], np.stack([whole[c] for c in COLOR], axis=1))
    np.testing.assert_allclose(got["intensity"], whole["intensity"], rtol=1e-6)
    assert source.n_points == 155_201 and source.stations == ((0, 0, 0),)
    np.testing.assert_allclose(source.bounds, [got["position"].min(axis=0), got["position"].max(axis=0)], atol=1e-5)


def test_e57__pump_image_without_a_pose_is_named():
    got = inspect_scan(shared_scan(PUMP))
    assert got["cameras"]["count"] == 0
    assert any("'pumpVisual' is not used: its representation is visualReference" in w for w in got["warnings"])
    json.dumps(got, allow_nan=False)


@pytest.mark.parametrize(
    "change, found",
    [
        (lambda b: b[:7], "7 bytes; allowed: an E57 file, whose header alone has 48"),
        (lambda b: b[:1024], "1024 bytes, of which its header says that they are"),
        (lambda b: b + b"xx", "something was added to it"),
        (lambda b: b"X" * len(b), "it begins with b'XXXXXXXX'; allowed: b'ASTM-E57'"),
        (lambda b: b[:600] + bytes([b[600] ^ 1]) + b[601:], "the checksum of page 0 is wrong"),
    ],
)
def test_e57__damage_is_told_in_our_own_words(tmp_path, change, found):
    path = write(tmp_path / "whole.e57", cartesian())
    broken = tmp_path / "broken.e57"
    broken.write_bytes(change(open(path, "rb").read()))
    with pytest.raises(InvalidScan, match=re.escape(found)) as error:
        open_scan(str(broken))
    assert "Error" not in str(error.value) and "internal" not in str(error.value)


@pytest.mark.parametrize("span, rise", [(2 * np.pi, 1.0), (2 * np.pi, 2.8), (2 * np.pi, np.pi), (1.0, 0.8)])
def test_e57__what_of_a_panorama_is_not_used_is_a_number(span, rise):
    whole = Panorama(720, 240, span / 720, 120, rise / 240)
    row, column = np.mgrid[:240, :720] + 0.5
    azimuth, rise = (360 - column) * whole.pixel_width, (120 - row) * whole.pixel_height
    flat = np.cos(rise)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(rise)], axis=-1)
    shown = np.zeros((240, 720), bool)
    for part in parts_of(whole):
        x, y, z = np.moveaxis(rays @ np.array(part.rotation).T, -1, 0)
        u, v = x / z * part.focal_px + part.cx_px, y / z * part.focal_px + part.cy_px
        shown |= (z > 0) & (u > -0.5) & (u < part.width_px + 0.5) & (v > -0.5) & (v < part.height_px + 0.5)
    assert abs((1 - shown.mean()) - share_left_out(whole)) < 0.012
