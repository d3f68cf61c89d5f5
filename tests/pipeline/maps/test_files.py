"""Maps as pictures: upright, whole, and back again with what somebody painted."""

import json

import numpy as np
import OpenImageIO as oiio
import pytest

from pipeline.maps.files import COLOR, DEPTH, POSE, from_upright, has_map, name_of, read_edited, upright, write_map
from pipeline.maps.station_map import NOTHING, MapFrame, StationMap
from storage.errors import InvalidScan

HEIGHT = 20


@pytest.fixture
def drawn() -> StationMap:
    rng = np.random.default_rng(4)
    seen = rng.random((HEIGHT, 6 * HEIGHT)) < 0.7
    color = rng.integers(0, 256, (HEIGHT, 6 * HEIGHT, 4)).astype(np.uint8)
    color[..., 3] = 255
    depth = rng.integers(0, NOTHING, seen.shape).astype(np.uint16)
    frame = MapFrame(3, (10.0, -2.0, 0.5), HEIGHT, 0.5, 40.0)
    return StationMap(frame, np.where(seen[..., None], color, 0), np.where(seen, depth, NOTHING).astype(np.uint16))


def pixels_of(path) -> np.ndarray:
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    file = oiio.ImageInput.open(str(path), config)
    return file.read_image(0, 0, 0, file.spec().nchannels, file.spec().format)


def write_pixels(path, pixels: np.ndarray) -> None:
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], str(pixels.dtype))
    spec.attribute("oiio:UnassociatedAlpha", 1)
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec) and out.write_image(np.ascontiguousarray(pixels)) and out.close()


def test_upright__is_undone_exactly(drawn):
    np.testing.assert_array_equal(from_upright(upright(drawn.color)), drawn.color)
    np.testing.assert_array_equal(from_upright(upright(drawn.depth)), drawn.depth)


def test_write_map__pixels_lie_where_the_json_says(drawn, tmp_path):
    """Directions of pixels by the formulas of NAME.json alone, against the projection's."""
    files = write_map(tmp_path, drawn, "metre")
    assert files == [f"station_003{ending}" for ending in (COLOR, DEPTH, POSE)]
    told, h = json.loads((tmp_path / files[2]).read_text()), HEIGHT
    assert told["size_px"] == [6 * h, h] and told["unit"] == "metre" and told["step_degrees"] == 90 / h
    rows, columns = (a.ravel() + 0.5 for a in np.indices((h, 6 * h)))
    band, top = columns < 4 * h, (columns >= 4 * h) & (columns < 5 * h)
    theta, psi = 2 * np.pi * (1 - columns / (4 * h)), np.pi / 2 * (0.5 - rows / h)
    direction = np.stack([np.cos(psi) * np.cos(theta), np.cos(psi) * np.sin(theta), np.sin(psi)], axis=1)
    u, v = 0.5 - (columns % h) / h, np.where(top, 0.5 - rows / h, rows / h - 0.5)
    away = np.pi / 2 * np.hypot(u, v)
    azimuth = np.arctan2(v, u)
    pole = np.where(top, 1, -1) * np.cos(away)
    cap = np.stack([np.sin(away) * np.cos(azimuth), np.sin(away) * np.sin(azimuth), pole], axis=1)
    direction = np.where(band[:, None], direction, cap)
    expected = upright(drawn.color).reshape(-1, 4)
    np.testing.assert_array_equal(pixels_of(tmp_path / files[0]).reshape(-1, 4), expected)
    # the same pixel by the projection: where a direction falls on the map, and what the map has there
    found, _ = drawn.frame.projection.project(direction + np.array(drawn.frame.centre))
    owned = band | (away < np.pi / 4 - 1e-9)  # corners of caps show the band once more
    column, row = found[owned].astype(int).T
    np.testing.assert_array_equal(drawn.color[row, column], expected[owned])
    depth = pixels_of(tmp_path / files[1])
    assert depth.dtype == np.uint16
    np.testing.assert_array_equal(from_upright(depth[..., 0]), drawn.depth)


def test_read_edited__an_unchanged_picture_is_the_map(drawn, tmp_path):
    write_map(tmp_path, drawn, "metre")
    assert has_map(tmp_path, 3) and not has_map(tmp_path, 0)
    back = read_edited(tmp_path, drawn)
    np.testing.assert_array_equal(back.color, drawn.color)
    np.testing.assert_array_equal(back.depth, drawn.depth)


@pytest.mark.parametrize(("dtype", "channels"), [("uint8", 4), ("uint16", 4), ("uint8", 3)])
def test_read_edited__takes_colours_and_alpha_and_no_distance(drawn, tmp_path, dtype, channels):
    write_map(tmp_path, drawn, "metre")
    path = tmp_path / (name_of(3) + COLOR)
    picture = pixels_of(path)
    picture[2:6, 10:30] = [0, 200, 60, 255]
    picture[8:10, 40:60, 3] = 0
    write_pixels(path, picture[..., :channels].astype(dtype) * np.array(257 if dtype == "uint16" else 1, dtype))
    painted, erased = (np.zeros(picture.shape[:2], bool) for _ in range(2))
    painted[2:6, 10:30], erased[8:10, 40:60] = True, channels == 4
    painted, erased = from_upright(painted), from_upright(erased)
    back, was_seen = read_edited(tmp_path, drawn), drawn.depth != NOTHING
    assert (back.color[painted & was_seen] == [0, 200, 60, 255]).all()
    np.testing.assert_array_equal(back.depth, np.where(was_seen & ~erased, drawn.depth, NOTHING))
    np.testing.assert_array_equal(back.color[..., 3] > 0, was_seen & ~erased)
    kept = was_seen & ~painted & ~erased
    np.testing.assert_array_equal(back.color[kept], drawn.color[kept])


def test_read_edited__refuses_what_is_no_map_of_this_station(drawn, tmp_path):
    write_map(tmp_path, drawn, "metre")
    color, pose = (tmp_path / (name_of(3) + ending) for ending in (COLOR, POSE))
    whole_picture, whole_pose = color.read_bytes(), pose.read_text()
    write_pixels(color, np.zeros((HEIGHT, 5 * HEIGHT, 4), np.uint8))
    with pytest.raises(InvalidScan, match=r"100 x 20 pixels.*120 x 20"):
        read_edited(tmp_path, drawn)
    color.write_bytes(whole_picture[: len(whole_picture) // 2])
    with pytest.raises(InvalidScan, match="damaged|unreadable"):
        read_edited(tmp_path, drawn)
    color.write_bytes(b"no picture")
    with pytest.raises(InvalidScan, match="unreadable"):
        read_edited(tmp_path, drawn)
    color.write_bytes(whole_picture)
    for text, words in (
        (json.dumps(json.loads(whole_pose) | {"height_px": 21}), "21 rows"),
        (json.dumps(json.loads(whole_pose) | {"centre": [0, 0, 0]}), "another scan"),
        (json.dumps(json.loads(whole_pose) | {"centre": None}), "TypeError"),
        ("[", "Decode"),
        ("[]", "TypeError"),
    ):
        pose.write_text(text)
        with pytest.raises(InvalidScan, match=words):
            read_edited(tmp_path, drawn)
    pose.unlink()
    with pytest.raises(InvalidScan, match="missing"):
        read_edited(tmp_path, drawn)
