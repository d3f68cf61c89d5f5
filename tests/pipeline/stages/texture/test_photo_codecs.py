"""Real encoders: what they take, and that what they decode to is the photograph."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.stages.texture.photo_codecs import CODECS, MIP_LEVELS, halved

BLOCK_BYTES = {"bc7": 16, "bc1": 8, "bc1-fast": 8}


def photo(height: int, width: int, seed: int = 0) -> np.ndarray:
    """Smooth, with another wave in each channel, so that swapped channels or sides show."""
    y, x = np.mgrid[:height, :width] / 16.0
    waves = [np.sin(x + seed), np.cos(0.7 * y), np.sin(0.4 * (x - y))]
    return np.round(127 + 90 * np.stack(waves, axis=-1)).astype(np.uint8)


def psnr_db(a: np.ndarray, b: np.ndarray) -> float:
    return -10 * np.log10(np.mean((a.astype(float) - b) ** 2) / 255**2)


@pytest.mark.parametrize(("codec", "least_db"), [("bc7", 45), ("bc1", 36), ("bc1-fast", 34)])
@pytest.mark.parametrize("size", [(64, 96), (37, 50), (3, 5)])
def test_photo_codecs__block_codes_decode_to_the_photograph_at_their_rate(codec, least_db, size):
    rgb = photo(*size)
    decoded, n_bytes = CODECS[codec].coded(rgb, None)
    assert decoded.shape == rgb.shape and decoded.dtype == np.uint8 and psnr_db(decoded, rgb) > least_db
    levels = [(max(1, size[0] >> i), max(1, size[1] >> i)) for i in range(MIP_LEVELS)]
    assert n_bytes == sum(BLOCK_BYTES[codec] * ((h + 3) // 4) * ((w + 3) // 4) for h, w in levels)


def test_photo_codecs__raw_pixels_are_themselves_at_three_bytes_and_their_mip_levels():
    rgb = photo(32, 64)
    decoded, n_bytes = CODECS["raw"].coded(rgb, None)
    assert np.array_equal(decoded, rgb) and n_bytes == 3 * (32 * 64 + 16 * 32 + 8 * 16 + 4 * 8 + 2 * 4)


@pytest.mark.parametrize("codec", ["jpeg", "webp", "avif"])
def test_photo_codecs__pictures_keep_to_their_budget_and_use_it(codec):
    rng = np.random.default_rng(0)
    rgb = np.clip(photo(96, 128) + rng.normal(0, 12, (96, 128, 3)), 0, 255).astype(np.uint8)
    found = [CODECS[codec].coded(rgb, budget) for budget in (2000, 8000)]
    assert found[0][1] <= 2000 < found[1][1] <= 8000
    assert 20 < psnr_db(found[0][0], rgb) < psnr_db(found[1][0], rgb)


def test_photo_codecs__a_budget_below_the_lowest_quality_gives_the_lowest():
    decoded, n_bytes = CODECS["jpeg"].coded(photo(64, 64), 10)
    assert n_bytes > 10 and decoded.shape == (64, 64, 3)


@pytest.mark.parametrize("size", [(64, 48), (33, 51), (1, 7)])
def test_photo_codecs__half_a_photograph_has_its_mean(size):
    rgb = photo(*size)
    half = halved(rgb, 1)
    assert half.shape[:2] == tuple(max(1, s // 2) for s in size)
    np.testing.assert_allclose(half.mean(axis=(0, 1)), rgb.mean(axis=(0, 1)), atol=0.6)
    assert halved(rgb, 0) is rgb
