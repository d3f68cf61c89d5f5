import numpy as np
import pytest

from storage import arrays


@pytest.mark.parametrize(("start", "stop", "rows"), [(0, 10, 3), (2, 9, 4), (4, 8, 4), (5, 6, 100), (3, 3, 2)])
def test_arrays__pieces_are_the_rows_in_order_across_chunks(tmp_path, start, stop, rows):
    whole = np.arange(30, dtype=np.int16).reshape(10, 3)
    arrays.store(tmp_path, "a", whole, (4, 3))
    found = list(arrays.pieces(tmp_path, "a", start, stop, rows))
    assert [at for at, _ in found] == list(range(start, stop, rows))
    assert np.array_equal(np.concatenate([piece for _, piece in found] or [whole[:0]]), whole[start:stop])


def test_arrays__what_cannot_be_read_ahead_is_raised_where_it_is_asked_for(tmp_path):
    with pytest.raises(FileNotFoundError):
        next(arrays.pieces(tmp_path, "missing", 0, 4, 2))
