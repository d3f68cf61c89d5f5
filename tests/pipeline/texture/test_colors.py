import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pipeline.texture.color_axes import fit_turns, turned, turned_back
from pipeline.texture.colors import AXES, decode_colors, encode_colors, fit_color_boxes, length_of, step_for
from storage.packed.schema import CHUNK, COARSEST_COLOR_STEP, COLOR_TURN_W, FINEST_COLOR_STEP, MOST_COLOR_BITS

COLORS = st.integers(1, 300).flatmap(
    lambda n: arrays(
        np.float64,
        (n, 3),
        elements=st.one_of(
            st.floats(0, 255), st.floats(100, 104), st.sampled_from([0.0, 255.0, 127.5, 1 / 1024, 1e-30])
        ),
    )
)
STEPS = st.integers(FINEST_COLOR_STEP, COARSEST_COLOR_STEP)
CORNERS = np.array(np.meshgrid([0.0, 255.0], [0.0, 255.0], [0.0, 255.0])).reshape(3, 8).T


def coded(color, step):
    boxes = fit_color_boxes(color, step)
    code = encode_colors(color, boxes)
    return boxes, code, decode_colors(code, boxes)


def off_along(found, color, boxes):
    """How far colours are off along the axes of their boxes."""
    return np.abs(turned((found - color) @ AXES.T, boxes.turn))


@settings(deadline=None, derandomize=True, max_examples=300)
@given(COLORS, STEPS)
def test_colors__come_back_within_half_a_step_or_a_step_at_edges_on_every_axis(color, step):
    boxes, code, found = coded(color, step)
    assert found.dtype == np.float32 and found.min() >= 0 and found.max() <= 255
    half, rounding = length_of(step) / 2, 1e-4
    inside = ((found > 0) & (found < 255)).all(axis=1)  # what is clamped comes nearer in its channels
    off, along, chunk = (
        off_along(found, color, boxes),
        turned(color @ AXES.T, boxes.turn),
        np.arange(len(color)) // CHUNK,
    )
    low = boxes.low[chunk] / 32
    in_box = (low <= along) & (along <= low + length_of(boxes.size)[chunk])
    assert (off[inside] <= np.where(in_box, half, 2 * half)[inside] + rounding).all()
    assert (np.linalg.norm(found - color, axis=1) <= 2 * half * 3**0.5 + rounding).all()


@settings(deadline=None, derandomize=True, max_examples=200)
@given(COLORS, STEPS)
def test_colors__codes_have_the_bits_of_their_chunk(color, step):
    boxes, code, _ = coded(color, step)
    bits = boxes.bits.sum(axis=1)
    assert bits.max() <= MOST_COLOR_BITS
    assert (code < 2 ** bits[np.arange(len(color)) // CHUNK]).all()


@settings(deadline=None, derandomize=True, max_examples=200)
@given(COLORS)
def test_colors__boxes_hold_their_colours_but_for_half_a_cell_and_are_tight(color):
    boxes = fit_color_boxes(color, 112)
    along, reach = turned(color @ AXES.T, boxes.turn), length_of(112) / 2
    for chunk, start in enumerate(range(0, len(color), CHUNK)):
        points = along[start : start + CHUNK]
        low, size = boxes.low[chunk] / 32, length_of(boxes.size[chunk])
        assert (low <= points.min(axis=0) + reach + 1e-9).all()
        assert (points.max(axis=0) <= low + size + reach + 1e-9).all()
        assert (size <= np.maximum(np.ptp(points, axis=0) + 1 / 32, 2**-6) * 2 ** (1 / 16) + 1e-9).all()


def test_colors__axes_follow_a_material_that_is_lit_in_many_ways():
    """Shades of one red lie on a line that is none of greys: one axis has bits, where luma and chroma have two or more."""
    rng = np.random.default_rng(2)
    shades = np.array([180.0, 60.0, 30.0]) * rng.uniform(0.4, 1.2, (4 * CHUNK, 1)) + rng.normal(0, 0.2, (4 * CHUNK, 3))
    boxes, _, found = coded(shades, 112)
    assert (boxes.bits > 0).sum(axis=1).max() == 1 and boxes.bits.sum(axis=1).max() <= 7
    spread = np.ptp((shades @ AXES.T).reshape(4, CHUNK, 3), axis=1)
    assert (np.ceil(np.log2(spread / 2)).clip(0).sum(axis=1) >= 12).all()
    assert np.sqrt(((found - shades) ** 2).mean()) < 2 / np.sqrt(12)


def test_axes__are_named_and_directed_so_that_turns_are_small():
    rng = np.random.default_rng(3)
    color = rng.normal(0, [1, 2, 9], (200 * CHUNK, 3)) @ np.linalg.qr(rng.normal(size=(3, 3)))[0] + 128
    color.reshape(200, CHUNK, 3)[:] = color.reshape(200, CHUNK, 3) @ np.linalg.qr(rng.normal(size=(200, 3, 3)))[0]
    turn = fit_turns(color)
    along = turned(color, turn).reshape(200, CHUNK, 3)
    off = along - along.mean(axis=1, keepdims=True)
    spread = np.einsum("cij,cik->cjk", off, off)
    across = np.abs(spread[:, [0, 0, 1], [1, 2, 2]]).max(axis=1) / np.trace(spread, axis1=1, axis2=2)
    assert across.max() < 0.01  # but for the rounding of a quaternion's bytes, the axes of spread
    assert np.abs(turn.astype(int)).sum(axis=1).max() <= COLOR_TURN_W + 3 and turn.any(axis=1).all()
    assert np.allclose(turned_back(turned(color, turn), turn), color, atol=1e-9)


def test_colors__a_box_of_all_colours_takes_what_a_shader_can_read():
    boxes, code, found = coded(CORNERS, FINEST_COLOR_STEP)
    assert boxes.bits.sum() == MOST_COLOR_BITS == 30
    assert np.abs(found - CORNERS).max() < 0.45


def test_colors__a_chunk_of_one_colour_takes_no_bits():
    boxes, code, found = coded(np.tile([17.25, 200.5, 90.125], (CHUNK, 1)), step_for(1.0))
    assert boxes.bits.sum() == 0 and not code.any()
    assert np.abs(found - [17.25, 200.5, 90.125]).max() < 0.05


@pytest.mark.parametrize("step", [80, 96, 112, 128])
def test_colors__random_chunks_are_as_exact_as_flat_ones_are_allowed_to_be(step):
    """A hostile chunk costs bits, not error: each channel's error is that of even noise in cells no larger than the
    step."""
    rng = np.random.default_rng(0)
    color = rng.uniform(0, 255, (50 * CHUNK, 3))
    boxes, _, found = coded(color, step)
    assert np.sqrt(((found - color) ** 2).mean()) <= length_of(step) / np.sqrt(12)
    assert boxes.bits.sum(axis=1).min() >= 3 * np.log2(255 / length_of(step)) - 1


def test_colors__chunks_know_nothing_of_each_other():
    rng = np.random.default_rng(1)
    color = rng.uniform(0, 255, (3 * CHUNK + 5, 3))
    whole = coded(color, 100)[2]
    parts = [coded(color[start : start + CHUNK], 100)[2] for start in range(0, len(color), CHUNK)]
    assert (np.concatenate(parts) == whole).all()


@pytest.mark.parametrize(("length", "code"), [(2.0, 112), (1.0, 96), (1.99, 111), (0.5, 80), (0.01, 80), (1e9, 255)])
def test_colors__steps_are_no_larger_than_asked_for(length, code):
    assert step_for(length) == code
    assert length_of(code) <= max(length, 0.5)
