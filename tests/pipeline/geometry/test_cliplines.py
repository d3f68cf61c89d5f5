import numpy as np
import pytest

from pipeline.geometry.cliplines import decode_cliplines, encode_cliplines
from storage.packed.schema import CLIPLINE_BITS


def lines(n: int = 2000) -> np.ndarray:
    rng = np.random.default_rng(0)
    angle = rng.uniform(0, 2 * np.pi, n)
    return np.column_stack([np.cos(angle), np.sin(angle), rng.uniform(-1, 1, n)])


def test_cliplines__every_code_comes_back():
    code = np.arange(1 << CLIPLINE_BITS, dtype=np.uint32)
    code = code[((code & 15) < 15) & ((code >> 4 & 15) < 15) & (code >> 8 < 15)]  # 15 stands for nothing
    assert (encode_cliplines(decode_cliplines(code)) == code).all()


def test_cliplines__coefficients_come_back_within_half_a_step():
    line = lines()
    code = encode_cliplines(line)
    assert code.dtype == np.uint32 and code.max() < 1 << CLIPLINE_BITS
    assert np.abs(decode_cliplines(code) - line).max() <= 1 / 14 + 1e-12


def test_cliplines__a_lies_lowest_then_b_then_c():
    assert encode_cliplines(np.array([[1, -1, -1], [-1, 1, -1], [-1, -1, 1]])).tolist() == [0x00E, 0x0E0, 0xE00]


def test_cliplines__cut_within_a_sixth_of_the_radius_of_where_they_should():
    line = lines()
    found = decode_cliplines(encode_cliplines(line))
    found /= np.linalg.norm(found[:, :2], axis=1, keepdims=True)
    assert np.abs(found[:, 2] - line[:, 2]).max() < 1 / 6


@pytest.mark.parametrize("c", [1.0, 5.0])
def test_cliplines__a_line_that_cuts_nothing_away_keeps_the_disc(c):
    a, b, c = decode_cliplines(encode_cliplines(np.array([[0.0, 0.0, c]])))[0]
    assert c - np.hypot(a, b) > 0


def test_cliplines__lines_along_the_axes_are_exact():
    line = np.array([[1.0, 0, 0], [0, -1, 0], [0, 1, -1]])
    assert (decode_cliplines(encode_cliplines(line)) == line).all()


def test_cliplines__none_have_no_codes():
    assert encode_cliplines(np.zeros((0, 3))).shape == (0,)
    assert decode_cliplines(np.zeros(0, np.uint32)).shape == (0, 3)
