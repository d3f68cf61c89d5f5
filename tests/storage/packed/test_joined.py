"""One file of what tasks wrote side by side: the bytes that Python's zipfile would write, whoever wrote what when."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import pytest

from pipeline.stages.packed import kinds
from renderer.report.report import build_report, sizes_from, sizes_of
from storage.packed.packed import PackedFile
from storage.packed.schema import GROUP
from storage.packed.seal import SEAL_BYTES
from storage.packed.writing import joined, writer
from storage.packed.writing.joined import lay_out, seal_packed
from storage.packed.writing.writer import n_pieces, piece_of, told_file, write_piece
from storage.packed.writing.zipped import LONGEST, end_of, entries, entries_in_rows
from storage.work import arrays
from tests.packed_files import UNSEALED, Case, arrays_for, fill_folder, header_of, write_packed_file

CASE = Case(n_splats=2 * GROUP + 300, period=128, cliplines=True, n_dictionary=3)  # three pieces


@pytest.fixture(scope="module", autouse=True)
def pieces_of_a_group():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, "GROUPS_AT_ONCE", 1)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("packed") / "folder"
    fill_folder(header_of(CASE), arrays_for(CASE, header_of(CASE)), folder)
    return folder


@pytest.fixture(scope="module")
def whole(folder):
    seal_packed(folder, folder.parent / "whole.splatpress")
    return (folder.parent / "whole.splatpress").read_bytes()


def test_joined__is_what_zipfile_writes(whole, tmp_path):
    with zipfile.ZipFile(io.BytesIO(whole)) as made, zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        for name in made.namelist():
            info = zipfile.ZipInfo(name)
            info.create_system, info.external_attr = 3, 0o644 << 16
            archive.writestr(info, made.read(name))
        archive.comment = UNSEALED
    assert (tmp_path / "a.zip").read_bytes()[:-SEAL_BYTES] == whole[:-SEAL_BYTES]


class Far:
    """A file that begins far away."""

    def __init__(self):
        self.written, self.at = [], START

    def write(self, data):
        self.written.append(data)
        self.at += len(data)

    def tell(self):
        return self.at

    def seek(self, *_): ...

    def flush(self): ...

    seekable = lambda self: True


START = 3 * LONGEST


@pytest.mark.parametrize("n", [3, 70_000])
def test_joined__a_directory_beyond_what_32_bits_hold_is_what_zipfile_writes(n):
    at = np.array([0, LONGEST, LONGEST + 1, *range(START - n + 3, START)])
    names, crc, size = [f"a/c/{i}" for i in range(n)], np.arange(n) * 7919, np.arange(n) % 999
    archive = zipfile.ZipFile(Far(), "w")
    for name, c, s, place in zip(names, crc.tolist(), size.tolist(), at.tolist()):
        info = zipfile.ZipInfo(name)
        info.CRC, info.file_size, info.compress_size, info.header_offset = c, s, s, place
        info.create_system, info.external_attr = 3, 0o644 << 16
        archive.filelist.append(info)
    archive.start_dir, archive.comment = START, b"comment"
    archive._write_end_record()
    made = entries(names, crc, size, at)
    assert b"".join(archive.fp.written) == made + end_of(n, START, len(made), 7) + b"comment"


@pytest.mark.parametrize("first", [7, 95, 1000])
@pytest.mark.parametrize("start", [0, LONGEST - 600, LONGEST + 1])
def test_joined__rows_of_a_directory_are_what_it_says_of_each(first, start):
    names = [("a/c/", "/0"), ("codes/c/", "/0/0")]
    crc, size = np.random.default_rng(0).integers(0, 1 << 31, (2, 12, 2), dtype=np.int64) % [[[1 << 31]], [[99]]]
    at = start + 100 * np.arange(24).reshape(12, 2)
    flat = [f"{before}{i}{after}" for i in range(first, first + 12) for before, after in names]
    assert entries_in_rows(names, first, crc, size, at) == entries(flat, crc.ravel(), size.ravel(), at.ravel())


def test_joined__order_repeats_and_kills_leave_no_trace(folder, whole, tmp_path):
    """Pieces written last to first, again after the table, and one that was cut off half-way."""
    header, again = header_of(CASE), tmp_path / "folder"
    fill_folder(header, arrays_for(CASE, header), again)
    contents = {p: (piece_of(again, p).read_bytes(), told_file(again, p).read_bytes()) for p in range(n_pieces(header))}
    for piece in contents:
        piece_of(again, piece).unlink()

    def killed():
        yield from ()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_piece(again, header, 0, killed())
    assert not piece_of(again, 0).exists()
    for piece in reversed(contents):
        rows = np.frombuffer(contents[piece][1], writer.told_of(header))
        at = np.cumsum([0, *rows["bytes"].tolist()])
        groups = [
            (writer.WrittenGroup(**{k: row[k].tolist() for k in rows.dtype.names}), contents[piece][0][a:b])
            for row, a, b in zip(rows, at, at[1:])
        ]
        write_piece(again, header, piece, groups)
        assert (piece_of(again, piece).read_bytes(), told_file(again, piece).read_bytes()) == contents[piece]
    lay_out(again, header)
    lay_out(again, header)
    seal_packed(again, tmp_path / "a.splatpress")
    assert (tmp_path / "a.splatpress").read_bytes() == whole


@pytest.mark.parametrize(("of", "name", "value"), [(writer, "MOST_PIECES", 1), (joined, "BLOCK", 999)])
def test_joined__size_of_pieces_and_blocks_leaves_no_trace(of, name, value, whole, tmp_path, monkeypatch):
    monkeypatch.setattr(of, name, value)
    assert write_packed_file(CASE, tmp_path / "a.splatpress").read_bytes() == whole


def test_kinds__tasks_find_what_one_process_finds(tmp_path, monkeypatch):
    n = 5 * arrays.BLOCK - 7
    has, atoms = np.arange(n) > n - 3, (np.arange(n) // arrays.BLOCK).astype(np.uint8)
    for name, rows in (("n_atoms", atoms), ("has_clipline", has)):
        arrays.store(tmp_path, name, rows)
    monkeypatch.setattr(kinds, "PART", arrays.BLOCK + 1)
    stage = kinds.Kinds(n, tmp_path, (("clipline", tmp_path),))
    found = stage.finalise(tmp_path, [stage.run(tmp_path, i) for i in reversed(range(stage.init(tmp_path)))])
    assert found.batches == kinds.batches_of(n, stage.codes, stage.extras)
    assert [b.kind for b in found.batches] == [(0, False, False), (1, False, False), (2, False, False),
                                               (3, False, False), (4, False, False), (4, True, False)]  # fmt: skip
    assert stage.init(tmp_path) == 3


def test_joined__a_piece_of_another_length_is_not_sealed(folder, tmp_path):
    short = piece_of(folder, 1)
    content = short.read_bytes()
    try:
        short.write_bytes(content[:-1])
        with pytest.raises(joined.InternalError, match="short"):
            seal_packed(folder, tmp_path / "a.splatpress")
    finally:
        short.write_bytes(content)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "case",
    [
        CASE,
        Case(n_dictionary=0, atom_counts=(0,)),
        Case(color_step=112, size_bits=3),
        Case(quadrics=True),
        Case(ellipsoids=True),
        Case(n_maps=2, n_dictionary=0, atom_counts=(0,)),
    ],
)
def test_totals__are_those_of_all_that_is_loaded(case, tmp_path):
    with PackedFile(write_packed_file(case, tmp_path / "a.splatpress")) as opened:
        scene, totals = opened.load(), opened.totals()
    assert sizes_from(opened.header, totals.bytes, 7) == sizes_of(scene, 7)
    assert totals.splats.tolist() == scene.arrays["batch_count"].sum(axis=0, dtype=np.int64).tolist()
    assert build_report(scene, 7, totals=totals) == build_report(scene, 7)
