"""A file in archive form holds what its plain form does, group by group; whatever else its bytes are is refused."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from pipeline.splats.decoded import scene_normal_codes, scene_positions
from storage.errors import InvalidPackedFile
from storage.packed.archive import transcode
from storage.packed.archive.group import AS_THEY_STAND, CODED
from storage.packed.archive.transcode import archive_packed, plain_packed
from storage.packed.packed import PackedFile
from storage.packed.scene import PackedScene
from storage.packed.schema import BY_NAME, CHUNK, GROUP, QUADRICS, arrays_of
from tests.packed_files import Case, arrays_for, header_of, write_arrays, write_packed_file
from tests.storage.packed.test_packed import craft

NO_TEXTURE = Case(n_dictionary=0, atom_counts=(0,), n_cameras=0)
TWO_GROUPS = Case(n_splats=GROUP + 130, period=128, cliplines=True, size_bits=3, color_step=112, atom_size=8)
CASES = {
    "bytes of colours, batches that some chunks lack": Case(period=40),
    "one splat": replace(NO_TEXTURE, n_splats=1),
    "splats that are all the same": Case(period=1, size_bits=2, color_step=90),
    "every code wide": Case(dictionary_bits=16, weight_bits=8, n_dictionary=300),
    "sixteen atoms": Case(atom_size=8, n_turns=8, atom_counts=(0, 7, 9, 16), n_ranks=16, color_step=133),
    "cliplines and ellipsoids": Case(cliplines=True, ellipsoids=True, size_bits=4, color_step=80, period=60),
    "maps": replace(NO_TEXTURE, n_maps=2, size_bits=3, period=50),
    "two groups": TWO_GROUPS,
    "quadrics": Case(quadrics=True, cliplines=True, ellipsoids=True, size_bits=3, color_step=100, period=50),
    "two groups of quadrics": replace(TWO_GROUPS, quadrics=True),
    "one splat over a quadric": replace(NO_TEXTURE, n_splats=1, quadrics=True),
}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Of each case its plain form, its archive form, and the plain form of that."""
    made = {}
    for i, (name, case) in enumerate(CASES.items()):
        folder = tmp_path_factory.mktemp(f"case{i}")
        made[name] = [folder / f"{form}.splatpress" for form in ("plain", "archive", "back")]
        write_packed_file(case, made[name][0])
        archive_packed(*made[name][:2])
        plain_packed(*made[name][1:])
    return made


def loaded(path) -> PackedScene:
    with PackedFile(path) as opened:
        return opened.load()


def splats(scene: PackedScene) -> np.ndarray:
    """All that is known of each splat, a row each, sorted within its batch of its chunk."""
    header, arrays = scene.header, scene.arrays
    columns = [np.arange(header.n_splats) // CHUNK, scene.rows.batch, scene_positions(scene), scene_normal_codes(scene)]
    columns += [scene.size_codes] if header.size_bits else []
    columns += [scene.color_cells] if header.color_step else [arrays["color"]]
    columns += [arrays[name] for name in ("camera", "station") if name in arrays]
    for extra, table in (("clipline", "cliplines"), ("ellipsoid", "ellipsoid_word")):
        assert (table in arrays) == (scene.rows.extra[extra] >= 0).any()
    columns += [*scene.codes(), _lines(scene)]
    rows = np.column_stack([np.asarray(column, np.float64).reshape(header.n_splats, -1) for column in columns])
    return rows[np.lexsort(rows.T[::-1])]


def _lines(scene: PackedScene) -> np.ndarray:
    found = np.zeros((scene.header.n_splats, 5))
    some, fields = scene.ellipsoids
    found[some, :4] = fields
    if "cliplines" in scene.arrays:
        from storage.packed.bits import unpack_bits

        row = scene.rows.clipline
        has = np.flatnonzero(row >= 0)
        first = 32 * scene.arrays["clipline_word"][has // GROUP].astype(np.int64)
        found[has, 4] = unpack_bits(scene.arrays["cliplines"], first + 12 * row[has], 12)
    return found


@pytest.mark.parametrize("name", CASES)
def test_archive__holds_the_same_splats_chunks_and_dictionary(name, files):
    plain, archive, back = (loaded(path) for path in files[name])
    assert np.array_equal(splats(plain), splats(archive))
    for array in arrays_of(plain.header):
        if (
            array.dims[0] in "cgkrwyx" and not array.is_ragged and array.name not in ("sizes",)
        ) and array.name in plain.arrays:
            assert plain.arrays[array.name].tobytes() == archive.arrays[array.name].tobytes(), array.name
    assert archive.header == plain.header == back.header
    assert {n: a.tobytes() for n, a in archive.arrays.items()} == {n: a.tobytes() for n, a in back.arrays.items()}


@pytest.mark.parametrize("name", CASES)
def test_archive__made_again_is_the_same_bytes(name, files, tmp_path):
    plain, archive, back = files[name]
    archive_packed(back, tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == archive.read_bytes()
    if CASES[name].quadrics:  # whose splats stand by their numbers; what sizes hold beyond the end counts for nothing
        one, other = (loaded(path).arrays for path in (plain, back))
        assert all(np.array_equal(one[n], other[n]) for n in one if n != "sizes")


def test_archive__is_the_same_bytes_however_many_threads_make_it(files, tmp_path, monkeypatch):
    plain, archive, _ = files["two groups"]
    monkeypatch.setattr(transcode.os, "cpu_count", lambda: 1)
    archive_packed(plain, tmp_path / "one")
    assert (tmp_path / "one").read_bytes() == archive.read_bytes()
    archive_packed(archive, tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == archive.read_bytes()


def test_archive__takes_fewer_bytes_of_a_surface_and_no_more_than_arrays_of_noise(files, tmp_path):
    kinds = set()
    for _, archive, _ in files.values():
        with PackedFile(archive) as opened:
            kinds.add(int(opened._rows(BY_NAME["archive"])[0, 0]))
    assert kinds == {CODED, AS_THEY_STAND}  # both are looked at here
    case = replace(NO_TEXTURE, n_splats=2000)
    header, arrays = header_of(case), arrays_for(case, header_of(case))
    arrays["position"][:, 2] = 7
    arrays["box_bits"][:] = 8
    arrays["normal"][:] = 5, -9
    arrays["color"][:] = arrays["position"][:, :1]
    plain = write_arrays(header, arrays, tmp_path / "plain")
    archive_packed(plain, tmp_path / "archive")
    assert (tmp_path / "archive").stat().st_size < 0.75 * plain.stat().st_size
    assert np.array_equal(splats(loaded(tmp_path / "archive")), splats(loaded(plain)))


@pytest.mark.parametrize("name", ["two groups", "two groups of quadrics"])
def test_archive__a_group_alone_and_single_rows_are_those_of_the_plain_form(name, files):
    with PackedFile(files[name][1]) as archive, PackedFile(files[name][2]) as plain:
        assert archive.is_archive and not plain.is_archive
        assert np.array_equal(archive.groups.rows, plain.groups.rows)
        for index in range(2):
            one, other = archive.group(index), plain.group(index)
            assert all(np.array_equal(one.arrays[n], other.arrays[n]) for n in other.arrays)
        geometry = ("splats", "frame_turn") if archive.header.geometry == QUADRICS else ("position", "box_low")
        for array in (*geometry, "codes", "atoms_4", "weight_levels"):
            for start, stop in ((0, None), (1, 2), (5, 5)):
                assert np.array_equal(archive.read(array, start, stop), plain.read(array, start, stop))
        with pytest.raises(KeyError):
            archive.read("archive")


def test_archive__groups_of_a_large_file_begin_with_models_that_it_has(files, tmp_path, monkeypatch):
    monkeypatch.setattr(transcode, "LEAST_GROUPS", 2)
    archive_packed(files["two groups"][0], tmp_path / "a")
    with PackedFile(tmp_path / "a") as with_models, PackedFile(files["two groups"][1]) as without:
        assert with_models._priors is not None and with_models._priors.any() and without._priors is None
        assert with_models._rows(BY_NAME["archive"])[0].any()
        found = with_models.load().arrays
        for name, values in without.load().arrays.items():
            assert np.array_equal(found[name], values), name


def test_archive__runs_are_coded_already(tmp_path):
    plain = write_packed_file(
        Case(n_splats=200, period=128, n_dictionary=0, atom_counts=(0,), runs=True), tmp_path / "r"
    )
    with pytest.raises(InvalidPackedFile, match="runs, which are coded already"):
        archive_packed(plain, tmp_path / "a")
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize(
    "edit",
    [
        {"archive": {"dictionary_bytes": -1, "n_models": 0, "coder": 2}},
        {"archive": {"dictionary_bytes": 0, "n_models": 1 << 40, "coder": 2}},
        {"archive": {"dictionary_bytes": 1 << 60, "n_models": 0, "coder": 2}},
        {"archive": {"dictionary_bytes": 0, "n_models": 0}},
        {"archive": {"dictionary_bytes": 0, "n_models": 0, "coder": 1}},
        {"archive": {"dictionary_bytes": 10}},
        {"archive": 5},
        {"geometry": "runs"},
    ],
)
def test_archive__headers_that_do_not_fit_are_refused(edit, files, tmp_path):
    source = files["two groups"][1]
    with zipfile.ZipFile(source) as opened:
        root = json.loads(opened.read("zarr.json"))
    root["attributes"] |= edit
    changed = {"zarr.json": json.dumps(root).encode()}
    path = craft(source, tmp_path / "b.splatpress", lambda found: found.update(changed))
    with pytest.raises(InvalidPackedFile):
        PackedFile(path)
