"""Exposure compensation: what photographs disagree by is found, taken out, and left alone where there is none."""

import json

import numpy as np
import pytest

from pipeline.effects.exposure import exposed
from pipeline.effects.exposure.light import MOST_GAIN, N_TERMS, relit, terms
from pipeline.effects.exposure.photographs import read_photo
from pipeline.effects.exposure.solve import Observations, _by_splat, _medians, solve_fields, spread
from pipeline.execution.executors import SerialExecutor
from pipeline.numerics.srgb import linear_of, srgb_of
from pipeline.planning.settings import settings_for
from pipeline.summaries import Photographs
from renderer.evaluate.held_out import matched
from services.flow.prepare import prepare
from services.flow.run import Run
from services.processes.compress import compress
from services.processes.report import report
from storage.errors import InvalidScan
from storage.work import arrays, work
from tests.effects_scans import wall_scan
from tests.services.processes.test_compress import Heard

GAIN = (0.7, 1.0, 1.35)


def test_light__srgb_and_back():
    levels = np.arange(256) / 255
    assert np.abs(srgb_of(linear_of(levels)) - levels).max() < 1e-6


def test_light__no_gain_changes_no_pixel():
    pixels = np.random.default_rng(0).integers(0, 256, (40, 50, 3)).astype(np.uint8)
    assert np.array_equal(relit(pixels, np.zeros((3, N_TERMS))), pixels)


def test_light__a_field_is_applied_to_half_a_level():
    rng = np.random.default_rng(1)
    pixels, log_gain = rng.integers(0, 256, (60, 80, 3)).astype(np.uint8), rng.normal(0, 0.3, (3, N_TERMS))
    y, x = np.meshgrid((np.arange(60) + 0.5) / 30 - 1, (np.arange(80) + 0.5) / 40 - 1, indexing="ij")
    gain = np.exp(np.clip(terms(x, y) @ log_gain.T, -np.log(MOST_GAIN), np.log(MOST_GAIN)))
    exact = 255 * srgb_of(np.clip(linear_of(pixels / 255) * gain, 0, 1))
    whole = relit(pixels, log_gain)
    assert np.abs(whole - exact).max() < 0.6
    for left, top, right, bottom in ((0, 0, 1, 1), (13, 7, 80, 60), (5, 31, 38, 60), (60, 0, 77, 9)):
        part = np.ascontiguousarray(pixels[top:bottom, left:right])
        assert np.array_equal(relit(part, log_gain, (left, top), (80, 60)), whole[top:bottom, left:right])


def observations(fields: np.ndarray, wrong: float = 0.0, n: int = 1500) -> Observations:
    """Splats in all photographs, whose light is what `fields` take out; a share of them shows something else."""
    rng = np.random.default_rng(2)
    n_photos = len(fields)
    splat, photo = np.repeat(np.arange(n), n_photos), np.tile(np.arange(n_photos), n)
    x, y = rng.uniform(-1, 1, (2, n * n_photos))
    truth = rng.uniform(0.05, 0.4, (n, 3))[splat]
    light = truth * np.exp(-np.einsum("mt,mkt->mk", terms(x, y), fields[photo]))
    hidden = rng.random(len(splat)) < wrong
    light[hidden] = rng.uniform(0.01, 0.8, (hidden.sum(), 3))
    return Observations(splat, photo, x, y, light)


@pytest.mark.parametrize("wrong", [0.0, 0.15])
def test_solve__finds_gains_and_slopes_though_some_splats_are_hidden(wrong):
    fields = np.random.default_rng(3).normal(0, 0.12, (5, 3, N_TERMS)) * [1, 1, 1, 0.3, 0.3, 0.3]
    fields -= fields.mean(axis=0)
    seen = observations(fields, wrong)
    found = solve_fields(seen, 5)
    assert np.abs(found - fields)[:, :, 0].max() < 0.03 and np.abs(found - fields).max() < 0.06
    if not wrong:
        assert spread(seen, found) < 0.1 * spread(seen)


def test_solve__medians_are_those_of_numpy():
    rng = np.random.default_rng(6)
    splat, value = rng.integers(0, 90, 400), rng.normal(size=400).round(1)
    wanted = [np.median(value[splat == s]) for s in splat]
    np.testing.assert_array_equal(_medians(*_by_splat(splat), value), wanted)
    assert not len(_medians(*_by_splat(splat[:0]), value[:0]))


def test_solve__a_photograph_that_shares_no_splat_is_left_as_it_is():
    seen = observations(np.zeros((3, 3, N_TERMS)))
    found = solve_fields(seen, 4)
    assert np.abs(found).max() < 1e-6 and found.shape == (4, 3, N_TERMS)


def test_read_window__is_that_part_of_a_picture_whatever_its_tiles(tmp_path):
    picture = np.random.default_rng(7).integers(0, 256, (23, 31, 3)).astype(np.uint8)
    arrays.create(tmp_path, "picture", picture.shape, str(picture.dtype), (8, 10, 3))
    arrays.write_picture(tmp_path, "picture", picture)
    for top, bottom, left, right in ((0, 23, 0, 31), (7, 9, 9, 11), (8, 16, 10, 20), (22, 23, 30, 31), (3, 20, 5, 29)):
        found = arrays.read_window(tmp_path, "picture", top, bottom, left, right)
        assert np.array_equal(found, picture[top:bottom, left:right])


@pytest.fixture(scope="module")
def unlike(tmp_path_factory):
    folder = tmp_path_factory.mktemp("exposure")
    return wall_scan(folder / "wall", gain=GAIN), folder / "work"


def outcome(prepared) -> dict:
    return prepared.effects.outcomes["exposure"]


def test_exposure__is_found_from_the_splats_of_a_scan(unlike):
    scan, folder = unlike
    prepared = prepare(Run(folder, SerialExecutor(), Heard()), scan, None, "")
    gain = np.exp(np.array(outcome(prepared)["log_gain"])[:, :, 0])
    assert gain / gain[1] == pytest.approx(np.outer(1 / np.array(GAIN), np.ones(3)), rel=0.03)
    assert outcome(prepared)["spread_after"] < 0.2 * outcome(prepared)["spread_before"]
    photos = [read_photo(prepared.photos, i).astype(float) for i in range(3)]
    splats = arrays.read(prepared.splats.folder, "camera")
    assert (
        len(np.unique(splats)) > 1
        and work.summary(prepared.photos, Photographs).cameras == prepared.scan.summary.cameras
    )
    assert all(photo.mean() == pytest.approx(photos[1].mean(), rel=0.15) for photo in photos)


def test_exposure__a_photograph_that_is_held_out_has_no_say_and_stays_as_it_is(unlike):
    scan, folder = unlike
    prepared = prepare(Run(folder, SerialExecutor(), Heard()), scan, None, "exposure=on", held_out=(2,))
    gain = np.exp(np.array(outcome(prepared)["log_gain"])[:, :, 0])
    np.testing.assert_allclose(gain[2], 1.0)
    assert np.array_equal(read_photo(prepared.photos, 2), arrays.read(prepared.scan.folder, "photo_2"))
    # The two that are left agree half-way between them: a gain of 0.7 and of 1 meet at their geometric mean.
    np.testing.assert_allclose(gain[0], 0.7**-0.5, rtol=0.03)
    np.testing.assert_allclose(gain[1], 0.7**0.5, rtol=0.03)


def test_held_out__gains_of_the_photograph_are_taken_out_and_nothing_else():
    rng = np.random.default_rng(4)
    rgb = rng.integers(60, 160, (20, 30, 3)).astype(np.uint8)
    mask = rng.random((20, 30)) < 0.8
    photo = np.round(255 * srgb_of(np.clip(linear_of(rgb / 255.0) * [1.3, 0.8, 1.1], 0, 1))).astype(np.uint8)
    assert np.abs(matched(rgb, photo, mask).astype(int) - photo)[mask].max() <= 1
    assert np.array_equal(matched(rgb, photo, np.zeros_like(mask)), rgb)


def test_exposure__photographs_that_agree_are_left_alone(tmp_path):
    prepared = prepare(Run(tmp_path / "work", SerialExecutor(), Heard()), wall_scan(tmp_path / "wall"), None, "")
    row = next(row for row in prepared.effects.rows if row.effect == "exposure")
    assert not row.enabled and row.measure < 0.3 and prepared.photos == prepared.scan.folder


def test_exposure__takes_the_seams_out_of_the_packed_file_and_its_report_compares_like_with_like(unlike, tmp_path):
    scan, folder = unlike
    seams = {}
    for request in ("", "exposure=off"):
        settings = settings_for("draft", max_atoms=0, effects=request)
        made = compress(scan, tmp_path / "out", settings, SerialExecutor(), Heard(), render=False, work=folder)
        assert ("exposure" in [stage["name"] for stage in made["stages"]]) == (request == "")
        again = report(
            tmp_path / "out" / "wall.splatpress", scan, tmp_path / "again", SerialExecutor(), Heard(), render=False
        )
        assert again["quality"]["texture_psnr_db"] == pytest.approx(made["quality"]["texture_psnr_db"], abs=1e-3)
        seams[request] = _seam(tmp_path / "out" / "wall.splatpress")
    assert seams[""] < 0.3 * seams["exposure=off"]


def _seam(path) -> float:
    """How much more neighbours differ that different photographs textured than those of one photograph."""
    from scipy.spatial import cKDTree

    from pipeline.geometry.positions import Boxes, decode_positions
    from pipeline.stages.packed.measure import decoded_colors
    from storage.packed.packed import PackedFile

    with PackedFile(path) as packed:
        scene = packed.load()
    a, color = scene.arrays, decoded_colors(scene)
    position = a["position"].astype(np.uint32) @ np.array([1, 1 << 8, 1 << 16], np.uint32)
    centre = decode_positions(position, Boxes(a["box_low"], a["box_size"], a["box_bits"]))
    pairs = cKDTree(centre).query_pairs(0.03, output_type="ndarray")
    apart = np.abs(color[pairs[:, 0]] - color[pairs[:, 1]]).mean(axis=1)
    across = a["camera"][pairs[:, 0]] != a["camera"][pairs[:, 1]]
    assert across.any()
    return apart[across].mean() - apart[~across].mean()


@pytest.mark.parametrize(
    "wrong",
    [
        {},
        {"log_gain": "x"},
        {"log_gain": [[[0.0] * N_TERMS] * 3]},
        {"log_gain": [[[0.0] * 5] * 3] * 3},
        {"log_gain": [1, 2, 3]},
        {"log_gain": [[[float("nan")] * N_TERMS] * 3] * 3},
        {"log_gain": [[["a"] * N_TERMS] * 3] * 3},
    ],
)
def test_exposure__of_a_file_that_says_nonsense_is_refused(unlike, wrong):
    scan, folder = unlike
    prepared = prepare(Run(folder, SerialExecutor(), Heard()), scan, None, "exposure=off")
    with pytest.raises(InvalidScan, match="exposure"):
        exposed(prepared.scan.folder, json.loads(json.dumps(wrong)))
