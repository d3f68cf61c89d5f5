"""PSNR, SSIM and FLIP over a mask."""

import json
import math
import sys

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from pipeline.stages.texture import photo_codecs
from renderer.evaluate import compare
from renderer.evaluate.compare import BEST_DB, flip, not_measured, psnr_db, ssim
from storage.errors import ResourceExhausted

EVERYWHERE = np.ones((40, 60), bool)


def picture(seed=0, shape=(40, 60)):
    """A smooth picture, as rendered ones are; none of its values is near 0 or 255."""
    phase = np.random.default_rng(seed).uniform(0, 6, 3)
    y, x = np.mgrid[: shape[0], : shape[1]]
    waves = np.sin(x[..., None] / 5 + phase) + np.cos(y[..., None] / 7 + phase)
    return np.round(128 + 40 * waves).astype(np.uint8)


def noisy(rgb, sigma, seed=1):
    noise = np.random.default_rng(seed).normal(0, sigma, rgb.shape)
    return np.clip(np.round(rgb + noise), 0, 255).astype(np.uint8)


@pytest.fixture
def spot():
    mask = np.zeros((40, 60), bool)
    mask[13:19, 20:33] = True
    return mask


def test_psnr__of_a_constant_difference_is_what_the_formula_says():
    a = picture()
    assert psnr_db(a, a + 5, EVERYWHERE) == pytest.approx(20 * math.log10(255 / 5))
    assert psnr_db(a + 5, a, EVERYWHERE) == pytest.approx(20 * math.log10(255 / 5))


def test_psnr__averages_over_the_mask_and_the_channels(spot):
    a = picture()
    b = a.copy()
    b[13, 20, 0] += 30
    assert psnr_db(a, b, spot) == pytest.approx(10 * math.log10(255**2 / (30**2 / (spot.sum() * 3))))


def test_psnr__of_pictures_that_are_alike_is_the_best_and_fits_json():
    assert psnr_db(picture(), picture(), EVERYWHERE) == BEST_DB
    json.dumps(psnr_db(picture(), picture(), EVERYWHERE), allow_nan=False)


@pytest.mark.parametrize("measure", [psnr_db, ssim])
def test_measures__of_an_empty_mask_are_none(measure):
    assert measure(picture(0), picture(1), np.zeros((40, 60), bool)) is None


@pytest.mark.parametrize("measure", [psnr_db, ssim])
def test_measures__see_nothing_outside_the_mask(measure, spot):
    a, b = picture(), noisy(picture(), 8)
    elsewhere = np.where(spot[..., None], a, picture(9))
    assert measure(elsewhere, b, spot) == measure(a, b, spot)


@pytest.mark.parametrize("measure", [psnr_db, ssim])
def test_measures__fall_with_noise(measure, spot):
    a = picture()
    assert measure(a, noisy(a, 2), spot) > measure(a, noisy(a, 6), spot) > measure(a, noisy(a, 20), spot)


def test_ssim__of_pictures_alike_on_the_mask_is_one(spot):
    a = picture(0)
    assert ssim(np.where(spot[..., None], a, picture(1)), a, spot) == pytest.approx(1, abs=1e-6)


def test_ssim__of_the_whole_picture_is_that_of_wang_et_al_in_float64():
    a, b = picture(), noisy(picture(), 10)
    _, similarity = structural_similarity(
        a.astype(float),
        b.astype(float),
        channel_axis=2,
        data_range=255,
        full=True,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    assert ssim(a, b, EVERYWHERE) == pytest.approx(similarity.mean(), abs=1e-6)


def test_ssim__is_not_changed_by_looking_only_around_the_mask(spot):
    a, b = picture(shape=(300, 400)), noisy(picture(shape=(300, 400)), 10)
    mask = np.zeros((300, 400), bool)
    mask[100:140, 200:260] = spot
    filled = np.where(mask[..., None], a, b).astype(float)
    _, similarity = structural_similarity(
        filled,
        b.astype(float),
        channel_axis=2,
        data_range=255,
        full=True,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    assert ssim(a, b, mask) == pytest.approx(similarity[mask].mean(), abs=1e-6)


@pytest.mark.parametrize("shape", [(1, 1), (10, 60), (60, 10)])
def test_ssim__of_pictures_smaller_than_a_window_is_none(shape):
    assert ssim(picture(0, shape), picture(1, shape), np.ones(shape, bool)) is None


def test_ssim__of_pictures_of_one_window_is_a_number():
    assert 0 < ssim(picture(0, (11, 11)), noisy(picture(0, (11, 11)), 5), np.ones((11, 11), bool)) < 1


def test_flip__is_nothing_for_the_same_picture_and_grows_with_the_noise():
    b = picture()
    seen = [flip(noisy(b, sigma), b, EVERYWHERE) for sigma in (4, 12, 36)]
    assert flip(b, b, EVERYWHERE) == pytest.approx(0, abs=1e-6) and 0 < seen[0] < seen[1] < seen[2] < 1


def test_flip__of_black_and_white_is_nearly_the_most_there_is():
    assert flip(np.zeros((40, 60, 3), np.uint8), np.full((40, 60, 3), 255, np.uint8), EVERYWHERE) > 0.9


def test_flip__pixels_outside_the_mask_have_no_influence(spot):
    b = picture()
    a = noisy(b, 10)
    other = np.where(spot[..., None], a, 255 - a)
    assert flip(a, b, spot) == flip(other, b, spot) > 0
    assert flip(a, b, np.zeros_like(spot)) is None


def test_evaluation_without_its_packages__says_which_are_missing(monkeypatch):
    a = picture()
    assert not_measured() is None
    monkeypatch.setattr(compare, "find_spec", lambda name: None)
    assert flip(a, a, EVERYWHERE) is None and "FLIP was not measured" in not_measured()
    monkeypatch.setitem(sys.modules, "etcpak", None)
    with pytest.raises(ResourceExhausted, match=r"package etcpak: not installed; allowed: pip install"):
        photo_codecs.CODECS["bc7"].coded(a, None)
