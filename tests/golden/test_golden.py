"""Packed files that were written once must decode to the same numbers for ever."""

import json

import numpy as np
import pytest

from pipeline.geometry.cliplines import decode_cliplines
from pipeline.geometry.ellipsoids import decode_ellipsoids
from pipeline.geometry.normals import decode_normals
from pipeline.splats.decoded import scene_normal_codes, scene_positions, scene_radii
from pipeline.stages.packed.measure import decoded_colors
from storage.packed.bits import unpack_bits
from storage.packed.packed import SUFFIX, PackedFile
from storage.packed.schema import CLIPLINE_BITS, GROUP
from tests.golden.make_golden import CASES, EXPECTED, HERE, decoded_numbers, golden_file
from tests.packed_files import write_packed_file

NAMES = list(CASES)


@pytest.fixture(scope="module")
def expected():
    return json.loads(EXPECTED.read_text())


@pytest.fixture(scope="module")
def scenes():
    loaded = {}
    for name in NAMES:
        with PackedFile(golden_file(name)) as packed:
            loaded[name] = packed.load()
    return loaded


def assert_close(found, wanted, tolerance=1e-12):
    """The same nesting, and numbers equal to `tolerance`."""
    if isinstance(wanted, dict):
        assert found.keys() >= wanted.keys()  # newer versions say more
        for key in wanted:
            assert_close(found[key], wanted[key], tolerance)
    elif isinstance(wanted, (list, tuple)) and not _is_numeric(wanted):
        assert len(found) == len(wanted)
        for a, b in zip(found, wanted):
            assert_close(a, b, tolerance)
    elif _is_numeric(wanted):
        assert np.shape(found) == np.shape(wanted)
        np.testing.assert_allclose(found, wanted, rtol=tolerance, atol=tolerance)
    else:
        assert found == wanted


def _is_numeric(value) -> bool:
    if isinstance(value, (list, tuple)):
        return bool(value) and all(map(_is_numeric, value))
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def test_golden__every_file_has_its_case_and_its_numbers(expected):
    assert sorted(path.name for path in HERE.glob("*" + SUFFIX)) == sorted(name + SUFFIX for name in NAMES)
    assert sorted(expected) == sorted(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_golden__decodes_to_the_same_numbers(name, scenes, expected):
    assert_close(json.loads(json.dumps(decoded_numbers(scenes[name]))), expected[name])


@pytest.mark.parametrize("name", NAMES)
def test_golden__what_is_written_now_decodes_to_the_same_numbers(name, expected, tmp_path):
    with PackedFile(write_packed_file(CASES[name], tmp_path / ("new" + SUFFIX))) as packed:
        assert_close(json.loads(json.dumps(decoded_numbers(packed.load()))), expected[name])


@pytest.mark.parametrize("name", NAMES)
def test_golden__the_decoders_in_use_agree(name, scenes, expected):
    scene, wanted = scenes[name], expected[name]["splats"]
    splats = [int(i) for i in wanted]
    position, normal_code = scene_positions(scene), scene_normal_codes(scene)
    atom, weight = scene.codes()
    for i in splats:
        assert_close(position[i].tolist(), wanted[str(i)]["position"])
        assert_close(decode_normals(normal_code[i : i + 1])[0].tolist(), wanted[str(i)]["normal"])
        n_atoms = scene.n_atoms[i]
        assert [list(pair) for pair in zip(atom[i, :n_atoms], weight[i, :n_atoms])] == wanted[str(i)]["code"]


@pytest.mark.parametrize("name", NAMES)
def test_golden__radii_in_use_agree(name, scenes, expected):
    found, wanted = scene_radii(scenes[name]), expected[name]["splats"]
    for i in map(int, wanted):
        assert_close(float(found[i]), wanted[str(i)]["radius"])


@pytest.mark.parametrize("name", [name for name in NAMES if CASES[name].color_step])
def test_golden__boxes_of_colours_in_use_agree(name, scenes, expected):
    found = decoded_colors(scenes[name]) / 255
    for i, wanted in expected[name]["splats"].items():
        assert_close(found[int(i)].tolist(), wanted["color_in_box"], 1e-6)


def test_golden__cliplines_in_use_agree(scenes, expected):
    scene, wanted = scenes["cliplines"], expected["cliplines"]["splats"]
    with_line = [i for i in map(int, wanted) if wanted[str(i)]["clipline"]]
    without = [i for i in map(int, wanted) if not wanted[str(i)]["clipline"]]
    row, first_word = scene.rows.clipline, scene.arrays["clipline_word"]
    assert with_line and (row[with_line] >= 0).all() and (row[without] == -1).all()
    for i in with_line:
        first_bit = np.array([32 * int(first_word[i // GROUP]) + CLIPLINE_BITS * row[i]])
        code = unpack_bits(scene.arrays["cliplines"], first_bit, CLIPLINE_BITS)
        assert_close(decode_cliplines(code)[0].tolist(), wanted[str(i)]["clipline"])


def test_golden__ellipsoids_in_use_agree(scenes, expected):
    scene, wanted = scenes["ellipsoids"], expected["ellipsoids"]["splats"]
    header, row, first_word = scene.header, scene.rows.extra["ellipsoid"], scene.arrays["ellipsoid_word"]
    some = [i for i in map(int, wanted) if "ellipsoid" in wanted[str(i)]]
    assert some and [i for i in map(int, wanted) if row[i] >= 0] == some
    for i in some:
        word = scene.arrays["ellipsoids"][int(first_word[i // GROUP]) + row[i]]
        fields = np.frombuffer(word.tobytes(), np.uint8)[None]
        axes = decode_ellipsoids(
            fields, scene.arrays["normal"][i : i + 1], header.up, header.ahead, wanted[str(i)]["radius"]
        )
        assert_close(axes[0].tolist(), wanted[str(i)]["ellipsoid"], 1e-9)
