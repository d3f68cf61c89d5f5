import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pipeline.geometry.positions import POSITION_BITS, decode_positions, encode_positions, fit_boxes, share_bits
from storage.packed.schema import CHUNK

COORDINATES = st.one_of(
    st.floats(-1e6, 1e6), st.floats(-1e-30, 1e-30), st.sampled_from([0.0, -0.0, 1e30, -1e30, 5.4e6, 1 / 3, 1e-45])
)
POINTS = st.integers(1, 300).flatmap(lambda n: arrays(np.float64, (n, 3), elements=COORDINATES))


def half_cells(boxes, n: int) -> np.ndarray:
    """Half of a cell's extents for each of `n` positions, (n, 3)."""
    chunk = np.arange(n) // CHUNK
    return boxes.size[chunk].astype(np.float64) / 2.0 ** (boxes.bits[chunk].astype(int) + 1)


@pytest.mark.parametrize(
    "size, bits",
    [
        ([1, 2, 4], [7, 8, 9]),
        ([4, 1, 2], [9, 7, 8]),
        ([1, 1, 1], [8, 8, 8]),
        ([1, 0, 0], [24, 0, 0]),
        ([0, 5, 0], [0, 24, 0]),
        ([0, 3, 3], [0, 12, 12]),
        ([1e-30, 1, 1e-30], [0, 24, 0]),
        ([1e9, 1e9, 1], [12, 12, 0]),
    ],
)
def test_positions__bits_follow_the_logarithm_of_the_extents(size, bits):
    assert share_bits(np.array([size], np.float32)).tolist() == [bits]


@settings(deadline=None, derandomize=True, max_examples=200)
@given(arrays(np.float32, (4, 3), elements=st.floats(0, 2.0**100, width=32)))
def test_positions__bits_add_up_and_no_other_share_has_a_smaller_step(size):
    bits = share_bits(size)
    assert (bits.sum(axis=1, dtype=int) == POSITION_BITS).all()
    step = size.astype(np.float64) / 2.0**bits
    for row in range(4):
        for axis in np.flatnonzero(bits[row]):  # the step before an axis's last bit was the largest then, so it is now
            assert 2 * step[row, axis] >= step[row].max()


@settings(deadline=None, derandomize=True, max_examples=200)
@given(POINTS)
def test_positions__boxes_hold_their_points_and_are_tight(position):
    boxes = fit_boxes(position)
    assert boxes.low.dtype == boxes.size.dtype == np.float32
    for chunk, start in enumerate(range(0, len(position), CHUNK)):
        points = position[start : start + CHUNK]
        low, high = boxes.low[chunk].astype(float), boxes.low[chunk].astype(float) + boxes.size[chunk].astype(float)
        assert (low <= points.min(axis=0)).all() and (points.max(axis=0) <= high).all()
        room = 4 * np.spacing(np.abs(points).max(axis=0).astype(np.float32)).astype(float)
        assert (high - low - np.ptp(points, axis=0) <= room).all()


@settings(deadline=None, derandomize=True, max_examples=200)
@given(POINTS)
def test_positions__come_back_within_half_a_cell(position):
    boxes = fit_boxes(position)
    code = encode_positions(position, boxes)
    assert code.dtype == np.uint32 and (code < 1 << POSITION_BITS).all()
    error = np.abs(decode_positions(code, boxes) - position)
    rounding = 4 * np.finfo(float).eps * np.abs(position).max(axis=0)
    assert (error <= half_cells(boxes, len(position)) * (1 + 1e-9) + rounding).all()


@pytest.mark.parametrize("n", [1, 2, 127, 128, 129, 300])
def test_positions__last_chunk_may_be_short(n):
    position = np.random.default_rng(n).uniform(-3, 3, (n, 3))
    boxes = fit_boxes(position)
    assert boxes.low.shape == boxes.size.shape == boxes.bits.shape == (-(-n // CHUNK), 3)
    error = np.abs(decode_positions(encode_positions(position, boxes), boxes) - position)
    assert (error <= half_cells(boxes, n) + 1e-15).all()


def test_positions__float32_coordinates_of_points_that_are_equal_come_back_exactly():
    position = np.tile(np.array([0.1, -7.25, 3e5], np.float32).astype(float), (200, 1))
    boxes = fit_boxes(position)
    assert not boxes.size.any()
    assert (decode_positions(encode_positions(position, boxes), boxes) == position).all()


def test_positions__no_points_have_no_boxes():
    boxes = fit_boxes(np.zeros((0, 3)))
    assert boxes.low.shape == boxes.bits.shape == (0, 3)
    assert decode_positions(encode_positions(np.zeros((0, 3)), boxes), boxes).shape == (0, 3)


def test_positions__x_lies_lowest_then_y_then_z():
    position = np.array([[0, 0, 0], [7, 7, 7], [7, 0, 0], [0, 7, 0], [0, 0, 7]], float)
    code = encode_positions(position, fit_boxes(position))
    assert code.tolist() == [0, 0xFFFFFF, 0x0000FF, 0x00FF00, 0xFF0000]


def test_positions__each_splat_may_name_its_box():
    position = np.random.default_rng(3).uniform(-3, 3, (300, 3))
    boxes = fit_boxes(position)
    code, chunk = encode_positions(position, boxes), np.arange(300) // CHUNK
    some = [299, 5, 130]
    assert (decode_positions(code[some], boxes, chunk[some]) == decode_positions(code, boxes)[some]).all()


def test_positions__are_as_exact_far_from_the_world_s_origin_as_near():
    near = np.round(np.random.default_rng(4).uniform(-50, 50, (1000, 3)) * 2**20) / 2**20
    origin = np.array([4.5e5, 5.4e6, 100.0])
    against_origin = (near + origin) - origin
    boxes, far_boxes = fit_boxes(near), fit_boxes(against_origin)
    assert (encode_positions(near, boxes) == encode_positions(against_origin, far_boxes)).all()


def test_positions__mean_error_on_a_dense_wall_is_far_below_a_splat():
    rng = np.random.default_rng(5)  # 10 x 10 m, 2 cm splats, 4 to a point of the surface, 5 mm noise: the paper's case
    position = np.column_stack([rng.uniform(0, 1, (CHUNK * 64, 2)), rng.normal(0, 0.005, CHUNK * 64)])
    order = np.lexsort((position[:, 1], np.floor(position[:, 0] * 8)))
    position = position[order]
    boxes = fit_boxes(position)
    error = np.linalg.norm(decode_positions(encode_positions(position, boxes), boxes) - position, axis=1)
    assert error.mean() < 0.02 / 30


def test_positions__boxes_hold_their_points_and_are_not_larger_than_float32_calls_for():
    rng = np.random.default_rng(8)
    position = rng.standard_normal((40 * CHUNK, 3)) * 10 ** rng.uniform(-3, 3, (40 * CHUNK, 1))
    boxes = fit_boxes(position)
    rows = position.reshape(40, CHUNK, 3)
    low, size = boxes.low.astype(float), boxes.size.astype(float)
    assert (low <= rows.min(axis=1)).all() and (low + size >= rows.max(axis=1)).all()
    assert (np.nextafter(boxes.low, np.float32(np.inf)) > rows.min(axis=1)).all()
    assert (low + np.nextafter(boxes.size, np.float32(0)) < rows.max(axis=1)).all()
