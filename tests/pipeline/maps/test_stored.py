"""Maps as the packed file holds them: codes come back, colours keep their target, and what is no picture is refused."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pipeline.maps.sample import ALL_LEVELS, SHARE_OF_DISTANCE
from pipeline.maps.station_map import NOTHING, decode_distances
from pipeline.maps.stored import (
    MULTIPLES,
    VOID,
    codes_of,
    decode_codes,
    decode_colors,
    encode_codes,
    encode_map,
    filled,
    halved,
)
from pipeline.numerics.accuracy import psnr_db
from storage.errors import InvalidPackedFile
from tests.mapped_scenes import wall_map


@given(arrays(np.uint16, st.tuples(st.integers(1, 6), st.integers(1, 6))))
def test_stored__codes_come_back_whatever_they_are(codes):
    assert (decode_codes(*encode_codes(codes)) == codes).all()


def test_stored__distances_are_off_by_half_a_step_at_most():
    drawn = wall_map()
    codes = codes_of(drawn).astype(float)
    seen = drawn.depth != NOTHING
    assert ((codes == VOID) == ~seen).all() and 0.03 < seen.mean() < 0.5
    found = drawn.frame.nearest * np.exp((codes - 1) * SHARE_OF_DISTANCE)
    off = np.abs(np.log(found[seen] / decode_distances(drawn.depth, drawn.frame)[seen]))
    assert off.max() <= 0.5 * SHARE_OF_DISTANCE + 1e-9


@pytest.mark.parametrize("target_db", [34.0, 40.0])
def test_stored__colours_keep_the_target_where_there_is_a_surface_and_no_more_bytes_than_it_takes(target_db):
    drawn = wall_map()
    row, column = np.indices(drawn.depth.shape)
    waves = 128 + 90 * np.sin(row / 9 + column / 7)  # grey: WebP halves the resolution of hues
    drawn = replace(drawn, color=np.dstack([waves, waves, waves, drawn.color[..., 3]]).astype(np.uint8))
    made = encode_map(drawn, ALL_LEVELS, target_db)
    seen = drawn.depth != NOTHING
    color = decode_colors(made.stored, made.color, "a file")
    error = ((color[seen].astype(float) - drawn.color[seen][:, :3]) ** 2).sum() / 255**2
    assert made.n_values == 3 * seen.sum() and made.squared_error == pytest.approx(error)
    assert target_db <= psnr_db(error, made.n_values) < target_db + 4
    assert made.stored.color_bytes == len(made.color)


def test_stored__hues_that_webp_halves_are_kept_without_loss():
    made = encode_map(wall_map(), ALL_LEVELS, 40.0)  # a red post before waves of all hues: 30 dB at WebP's best quality
    assert MULTIPLES[made.quality] == 6 and 40 <= psnr_db(made.squared_error, made.n_values) < 46
    exact = encode_map(wall_map(), ALL_LEVELS, 80.0)
    assert MULTIPLES[exact.quality] == 1 and exact.squared_error == 0
    assert len(made.color) < 0.8 * len(exact.color)


def test_stored__colours_are_brought_to_one_light():
    darker = ALL_LEVELS * 0.5
    plain, dark = (encode_map(wall_map(), levels, 40.0) for levels in (ALL_LEVELS, darker))
    seen = wall_map().depth != NOTHING
    means = [decode_colors(made.stored, made.color, "a file")[seen].mean() for made in (plain, dark)]
    assert means[1] == pytest.approx(means[0] / 2, rel=0.02)


def test_stored__what_is_no_picture_of_the_map_is_refused():
    made, other = encode_map(wall_map(), ALL_LEVELS, 34.0), encode_map(wall_map(height=112), ALL_LEVELS, 34.0)
    for color in (made.color[:-40], np.zeros(100, np.uint8), np.zeros(0, np.uint8), other.color):
        with pytest.raises(InvalidPackedFile, match=r"a file: map_colors.*960 x 160"):
            decode_colors(made.stored, color, "a file")


def test_stored__halves_are_means_of_what_is_known():
    rng = np.random.default_rng(0)
    picture, known = rng.integers(0, 256, (6, 8, 3)).astype(np.uint8), rng.random((6, 8)) < 0.6
    mean, share = halved(picture, known)
    for y in range(3):
        for x in range(4):
            block = slice(2 * y, 2 * y + 2), slice(2 * x, 2 * x + 2)
            assert share[y, x] == known[block].mean()
            if known[block].any():
                np.testing.assert_allclose(mean[y, x], picture[block][known[block]].mean(axis=0), rtol=1e-5)


def test_stored__what_is_not_known_takes_after_what_is():
    picture, known = np.zeros((37, 50, 3), np.uint8), np.zeros((37, 50), bool)
    known[10:20, 5:30] = True
    picture[known] = [200, 100, 50]
    assert (filled(picture, known) == [200, 100, 50]).all()
