"""Pictures in compressed tiles: what is read is what was stored, from the tiles that it touches alone."""

import numpy as np
import pytest

from storage.work import tiles

RNG = np.random.default_rng(0)
# Cells of a few columns in a row that are one another's copies, as pictures of nearest points are.
PICTURE = np.repeat(RNG.normal(size=(600, 100, 3)), 3, axis=1).astype(np.float32)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("stage")
    tiles.store_tiles(made, "a", PICTURE)
    return made


def test_tiles__a_window_is_what_was_stored(folder):
    assert tiles.shape_of(folder, "a") == (600, 300, 3)
    for _ in range(40):
        top, left = RNG.integers(0, 600), RNG.integers(0, 300)
        bottom, right = RNG.integers(top + 1, 601), RNG.integers(left + 1, 301)
        assert np.array_equal(tiles.read_tiles(folder, "a", top, bottom, left, right), PICTURE[top:bottom, left:right])
    assert (folder / "a.tiles").stat().st_size < PICTURE.nbytes / 2


def test_tiles__what_a_window_does_not_touch_is_not_read(folder, tmp_path):
    tiles.store_tiles(tmp_path, "a", PICTURE)
    whole = (tmp_path / "a.tiles").read_bytes()
    last = tiles._about(tmp_path, "a")["begin"][-2]
    (tmp_path / "a.tiles").write_bytes(whole[:last] + b"\0" * (len(whole) - last))
    assert np.array_equal(tiles.read_tiles(tmp_path, "a", 0, 512, 0, 300), PICTURE[:512])
    with pytest.raises(RuntimeError):
        tiles.read_tiles(tmp_path, "a", 0, 600, 0, 300)


def test_tiles__equal_pictures_make_equal_bytes(folder, tmp_path):
    tiles.store_tiles(tmp_path, "a", PICTURE)
    for name in ("a.tiles", "a.tiles.json"):
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes()
