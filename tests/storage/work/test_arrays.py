import json

import numpy as np
import pytest
import zarr

from storage.work import arrays


@pytest.mark.parametrize(
    ("start", "stop", "rows", "begins"),
    [(0, 10, 3, [0, 3, 4, 7, 8]), (2, 9, 4, [2, 4, 8]), (4, 8, 4, [4]), (5, 6, 100, [5]), (3, 3, 2, [])],
)
def test_arrays__pieces_are_the_rows_in_order_within_chunks(tmp_path, start, stop, rows, begins):
    whole = np.arange(30, dtype=np.int16).reshape(10, 3)
    arrays.store(tmp_path, "a", whole, (4, 3))
    found = list(arrays.pieces(tmp_path, "a", start, stop, rows))
    assert [at for at, _ in found] == begins and not any(piece.flags.writeable for _, piece in found)
    assert np.array_equal(np.concatenate([piece for _, piece in found] or [whole[:0]]), whole[start:stop])


def test_arrays__what_cannot_be_read_ahead_is_raised_where_it_is_asked_for(tmp_path):
    with pytest.raises(FileNotFoundError):
        next(arrays.pieces(tmp_path, "missing", 0, 4, 2))


def zarrs_own(folder, name: str, shape: tuple, dtype: str, chunks: tuple) -> zarr.Array:
    return zarr.create_array(
        store=str(folder / f"{name}.zarr"),
        shape=shape,
        chunks=chunks,
        dtype=dtype,
        compressors=None,
        fill_value=0,
        chunk_key_encoding={"name": "default", "separator": "."},
    )


def files_of(folder, name: str) -> dict[str, bytes | dict]:
    found = {
        str(p.relative_to(folder / f"{name}.zarr")): p.read_bytes()
        for p in (folder / f"{name}.zarr").rglob("*")
        if p.is_file()
    }
    return found | {"zarr.json": json.loads(found["zarr.json"])}


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "int64", "float16", "float32", "float64", "bool"])
def test_arrays__are_files_as_zarr_writes_them(tmp_path, dtype):
    rows = np.random.default_rng(0).integers(0, 2, (23, 3)).astype(dtype)
    arrays.create(tmp_path, "ours", rows.shape, dtype, (8, 3))
    arrays.write(tmp_path, "ours", 0, rows[:16])
    arrays.write(tmp_path, "ours", 16, np.asfortranarray(rows[16:]))  # the last chunk, which is not full
    arrays.store(tmp_path, "stored", rows, (8, 3))
    appended = arrays.Appender(tmp_path, "appended", (3,), dtype, rows=8)
    for part in np.split(rows, [1, 5, 18]):
        appended.append(part)
    assert appended.close() == 23
    zarrs_own(tmp_path, "zarr", rows.shape, dtype, (8, 3))[:] = rows
    for name in ("ours", "stored", "appended"):
        assert files_of(tmp_path, name) == files_of(tmp_path, "zarr"), name
        assert (np.asarray(arrays.opened(tmp_path, name)[:]) == rows).all()
    for start, stop in ((0, None), (5, 19), (16, 23), (22, 30), (4, 4)):
        assert (arrays.read(tmp_path, "zarr", start, stop) == rows[start:stop]).all()
    assert len(list(tmp_path.rglob("*.partial*"))) == 0


def test_arrays__pictures_are_files_as_zarr_writes_them(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (21, 37, 3), np.uint8)
    arrays.create(tmp_path, "ours", pixels.shape, "uint8", (8, 16, 3))
    arrays.write_picture(tmp_path, "ours", pixels)
    zarrs_own(tmp_path, "zarr", pixels.shape, "uint8", (8, 16, 3))[:] = pixels
    assert files_of(tmp_path, "ours") == files_of(tmp_path, "zarr")
    assert (arrays.read_window(tmp_path, "ours", 3, 20, 10, 37) == pixels[3:20, 10:37]).all()
    with pytest.raises(ValueError, match=r"\(21, 37, 3\)"):
        arrays.write_picture(tmp_path, "ours", pixels[:20])


def test_arrays__an_empty_one_has_no_chunks(tmp_path):
    arrays.store(tmp_path, "none", np.empty((0, 5), np.float32))
    assert list(files_of(tmp_path, "none")) == ["zarr.json"] and arrays.read(tmp_path, "none").shape == (0, 5)


def test_arrays__one_that_is_packed_another_way_is_not_misread(tmp_path):
    zarr.create_array(store=str(tmp_path / "other.zarr"), shape=(8,), chunks=(8,), dtype="int32")[:] = np.arange(8)
    with pytest.raises(AssertionError, match="not an array that is made here"):
        arrays.read(tmp_path, "other")


def test_arrays__rows_within_a_chunk_leave_the_others(tmp_path):
    arrays.create(tmp_path, "some", (20,), "int32", (8,))
    arrays.write(tmp_path, "some", 3, np.arange(1, 8, dtype=np.int32))
    assert arrays.read(tmp_path, "some").tolist() == [0] * 3 + [*range(1, 8)] + [0] * 10


def test_arrays__chunks_never_written_are_zeros(tmp_path):
    arrays.create(tmp_path, "some", (20, 2), "float32", (8, 2))
    arrays.write(tmp_path, "some", 8, np.ones((8, 2), np.float32))
    assert arrays.read(tmp_path, "some").tolist() == [[0.0, 0.0]] * 8 + [[1.0, 1.0]] * 8 + [[0.0, 0.0]] * 4


@pytest.mark.parametrize(
    "rows", [np.ones((8, 3), np.float32), np.ones((24, 2), np.float32)], ids=["too wide", "too many"]
)
def test_arrays__rows_that_do_not_fit_are_refused(tmp_path, rows):
    arrays.create(tmp_path, "some", (20, 2), "float32", (8, 2))
    with pytest.raises(ValueError):
        arrays.write(tmp_path, "some", 0, rows)
    assert not arrays.read(tmp_path, "some").any()


def test_arrays__a_chunk_is_there_whole_or_not_at_all(tmp_path, monkeypatch):
    arrays.create(tmp_path, "some", (8,), "int32", (8,))
    monkeypatch.setattr("os.replace", lambda *a: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(OSError, match="No space"):
        arrays.write(tmp_path, "some", 0, np.arange(8, dtype=np.int32))
    assert not [p for p in (tmp_path / "some.zarr").rglob("*") if p.is_file() and p.name != "zarr.json"]
