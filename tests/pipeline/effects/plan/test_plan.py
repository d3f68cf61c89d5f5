"""The plan: what is on, and why."""

import json

import numpy as np
import pytest

from pipeline.effects import plan_effects
from pipeline.effects.accumulation import EFFECT as ACCUMULATION
from pipeline.effects.accumulation import overdraw
from pipeline.effects.antialiasing import EFFECT as ANTIALIASING
from pipeline.effects.block import Sources
from pipeline.effects.depth_margin import EFFECT as DEPTH_MARGIN
from pipeline.effects.depth_margin import LEAST_RADII, OVERLAP_RADII, histogram_of, residuals
from pipeline.effects.effect import Effect, Measured, Worth
from pipeline.effects.normal_smoothing import EFFECT as SMOOTHING
from pipeline.effects.normal_smoothing import LEAST_DEGREES, angles
from pipeline.effects.plan.plan import measured_effects
from pipeline.effects.plan.registry import effects
from pipeline.effects.plan.request import CHOICES, canonical_request, parse_request
from pipeline.texture.resample import Window, lookups_a_texel, resample_patches

WORTH = Worth("a scan of tests", seconds_a_million=2.0, bytes_a_splat=1.5, frame_share=0.1, gain_db=0.4)
KNOWN = {
    "lines": Effect("lines", "lines", "share of splats", 0.01, "tuned", WORTH),
    "light": Effect("light", "light", "nothing", 0.0, "a matter of taste", WORTH, by_request=True),
}


def plan(value: float | None, request: dict, **found):
    measures = {} if value is None else {"lines": Measured(value, value, {"lines": 3})}
    return plan_effects(measures | {name: Measured(v) for name, v in found.items()}, request, 2_000_000, KNOWN)


@pytest.mark.parametrize(
    ("value", "request_", "enabled"),
    [
        (0.02, "auto", True),
        (0.01, "auto", True),
        (0.0099, "auto", False),
        (0.0, "on", True),
        (0.5, "off", False),
        (None, "auto", False),
        (None, "on", False),
    ],
)
def test_plan__auto_is_on_from_the_threshold_on_and_a_request_overrules_it(value, request_, enabled):
    row = plan(value, {"lines": request_}).rows[0]
    assert row.enabled == enabled and row.request == request_ and row.measure == value


def test_plan__what_is_made_by_request_alone_needs_one():
    assert plan(0.0, {}, light=1.0).enabled == ()
    assert plan(0.0, {"light": "on"}, light=1.0).enabled == ("light",)


def test_plan__costs_are_those_of_the_splats_that_it_touches():
    row = plan(0.04, {}).rows[0]
    assert row.costs == {"seconds": 4.0, "bytes": 120_000, "frame_share": 0.1} and row.gives_db == 0.4


def test_plan__keeps_the_outcome_of_what_is_on_and_of_nothing_else():
    assert plan(0.04, {}).outcome("lines") == {"lines": 3} and plan(0.04, {"lines": "off"}).outcome("lines") is None


def test_plan__its_rows_are_json_and_say_what_the_issue_asks_for():
    rows = json.loads(json.dumps(plan(0.04, {}).to_json()))
    assert {"effect", "enabled", "share", "measure", "threshold", "reason"} <= rows[0].keys()
    assert rows[0]["reason"] == "0.04 reaches 0.01" and rows[0]["basis"]


def test_request__is_one_text_for_one_wish():
    names = list(effects())
    parts = [f"{name}={choice}" for name, choice in zip(names, CHOICES * len(names))]
    assert canonical_request(parts) == canonical_request(",".join(reversed(parts)))
    assert canonical_request("all=auto") == "" and "auto" not in canonical_request(parts)
    assert parse_request(canonical_request(parts)) == parse_request(parts)


@pytest.mark.parametrize("wrong", ["depth_margin", "depth_margin=yes", "fog=on", "=on", "depth_margin=on=off"])
def test_request__says_what_is_allowed(wrong):
    with pytest.raises(ValueError, match="allowed"):
        parse_request(wrong)


def test_request__what_is_off_is_not_measured():
    assert measured_effects(parse_request("all=off")) == ()
    assert measured_effects(parse_request("all=off,depth_margin=on")) == ("depth_margin",)


def test_registry__every_effect_says_what_it_is_and_where_its_threshold_comes_from():
    for name, effect in effects().items():
        assert effect.name == name and name.isidentifier()
        assert effect.title and effect.measures and effect.reason and effect.worth.measured_on


# --- depth margin --------------------------------------------------------------------------------------------------


def noisy_plane(noise_radii: float, n: int = 3000) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(0, 5, (n, 2)), rng.normal(0, noise_radii * 0.1, n)])


def test_depth_margin__residuals_are_those_of_every_pair_of_discs_that_overlap():
    rng = np.random.default_rng(8)
    position, normal = rng.uniform(0, 1, (120, 3)), rng.normal(size=(120, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    offset = position - position[::5, None]
    near = (np.linalg.norm(offset, axis=2) <= OVERLAP_RADII * 0.15) & (np.arange(120) != np.arange(0, 120, 5)[:, None])
    wanted = np.abs((offset * normal[::5, None]).sum(axis=2))[near] / 0.15
    assert len(wanted) > 50
    np.testing.assert_allclose(np.sort(residuals(position, normal, 0.15, every=5)), np.sort(wanted), atol=1e-12)


def margin(noise_radii: float) -> Measured:
    position = noisy_plane(noise_radii)
    off = residuals(position, np.tile([0.0, 0.0, 1.0], (len(position), 1)), 0.1, every=1)
    return DEPTH_MARGIN.conclude(
        [{"histogram": histogram_of(off)}] * 2, Sources(*[None] * 5, radius=0.1, up=(0, 0, 1), ahead=(1, 0, 0))
    )


def test_depth_margin__grows_with_the_noise_of_the_scan():
    quiet, noisy, wild = (margin(n) for n in (0.0, 0.3, 9.0))
    assert quiet.outcome["margin_radii"] == LEAST_RADII and quiet.value < DEPTH_MARGIN.threshold
    # 95 % of the differences of two normal deviates of 0.3 are below 1.96 * sqrt(2) * 0.3 = 0.83
    assert noisy.value == pytest.approx(0.83, rel=0.1) and noisy.outcome["margin_radii"] == pytest.approx(
        2 * noisy.value
    )
    assert noisy.outcome["margin_radii"] < wild.outcome["margin_radii"] <= 2 * OVERLAP_RADII


# --- accumulation --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("layers", "enabled"), [(1, False), (40, True)])
def test_accumulation__is_wide_where_a_scan_lies_many_times_on_itself(layers, enabled):
    rng = np.random.default_rng(1)
    grid = np.stack(np.meshgrid(np.arange(20), np.arange(20), [0]), axis=-1).reshape(-1, 3) * 0.1
    position = np.concatenate([grid + rng.normal(0, 0.003, grid.shape) for _ in range(layers)])
    found = overdraw(position, 0.1, every=7)
    # Of a grid as wide as the radius the four neighbours count nothing: a layer weighs about 1.
    assert np.median(found) == pytest.approx(layers, rel=0.15)
    sums = [{"n": len(found), "n_overdrawn": int((found > 16).sum()), "most": float(np.quantile(found, 0.99))}]
    plan = plan_effects({"accumulation": ACCUMULATION.conclude(sums, None)}, {})
    assert ("accumulation" in plan.enabled) == enabled


# --- what needs another effect
# ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("request_", "enabled"),
    [
        ({}, ()),
        ({"light": "on"}, ("light", "smooth")),
        ({"smooth": "on"}, ()),
        ({"light": "on", "smooth": "off"}, ("light",)),
    ],
)
def test_plan__what_needs_another_effect_is_on_with_it_only(request_, enabled):
    known = KNOWN | {"smooth": Effect("smooth", "smooth", "degrees", 0.3, "tuned", WORTH, needs="light")}
    measures = {"light": Measured(1.0), "smooth": Measured(2.0)}
    plan = plan_effects(measures, request_, 100, known)
    assert plan.enabled == enabled
    if not request_:
        assert plan.rows[-1].reason == "only with light"


def test_request__what_needs_another_effect_is_measured_with_it_only():
    assert "normal_smoothing" not in measured_effects(parse_request("normal_smoothing=on"))
    assert "normal_smoothing" in measured_effects(parse_request("relighting=on"))


def test_smoothing__angles_are_those_of_overlapping_splats_whichever_way_their_normals_point():
    position = np.array([[0.0, 0, 0], [0.5, 0, 0], [0.9, 0, 0], [5.0, 0, 0]])
    turned = np.radians([0, 10, 190, 45])
    normal = np.stack([np.sin(turned), 0 * turned, np.cos(turned)], axis=1)
    found = np.sort(angles(position, normal, 1.0, every=1))
    np.testing.assert_allclose(found, np.sort([10, 10, 10, 10, 0, 0]), atol=1e-9)
    assert SMOOTHING.threshold == LEAST_DEGREES == pytest.approx(np.degrees(1 / 178.5), abs=0.005)


# --- anti-aliasing
# --------------------------------------------------------------------------------------------------------


def test_antialiasing__asks_for_as_many_lookups_as_texels_cover_pixels():
    """Squares of 20, 40 and 90 px to a side, 32 texels each: 0.63, 1.25 and 2.8 pixels a texel."""
    h = np.array([[[s / 2, 0, 100], [0, s / 2, 100], [0, 0, 1]] for s in (20.0, 40.0, 90.0)])
    assert lookups_a_texel(h).tolist() == [[1, 1], [2, 2], [3, 3]]
    assert lookups_a_texel(h[:0]).shape == (0, 2)
    stripes = np.tile(np.where(np.arange(200) % 2, 255, 0).astype(np.uint8)[None, :, None], (200, 1, 3))
    plain, means = (resample_patches(Window(stripes, 0, 0), h, antialiased) for antialiased in (False, True))
    assert (plain[0] == means[0]).all() and means[2].std() < 0.5 * plain[2].std()


@pytest.mark.parametrize(("n_coarse", "enabled"), [(0, False), (1, False), (200, True)])
def test_antialiasing__is_on_where_some_splats_have_texels_of_several_pixels(n_coarse, enabled):
    measures = {"antialiasing": ANTIALIASING.conclude([{"n": 20_000, "n_coarse": n_coarse}], None)}
    assert ("antialiasing" in plan_effects(measures, {}).enabled) == enabled
