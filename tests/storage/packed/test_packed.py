"""A packed file is read as it was written, or refused; nothing lies between."""

import json
import os
import struct
import tracemalloc
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import zarr
from numcodecs.zstd import Zstd

from pipeline.geometry.normals import decode_normals
from pipeline.splats.decoded import scene_radii
from pipeline.stages.packed.measure import decoded_colors
from storage.errors import InternalError, InvalidPackedFile
from storage.packed import packed
from storage.packed.archive import transcode
from storage.packed.checks import check_frame
from storage.packed.groups import TABLE
from storage.packed.layout import metadata_of
from storage.packed.packed import PackedFile, is_packed_file
from storage.packed.scene import PackedScene
from storage.packed.schema import ARCHIVE, ARRAYS, BY_NAME, FORMS, GROUP, QUADRICS, RUNS, Batch, Header, arrays_of
from storage.packed.seal import SEAL_BYTES
from storage.packed.writing import joined
from storage.packed.writing.joined import lay_out, seal_packed
from storage.packed.writing.writer import create_array
from tests.packed_files import (
    UNSEALED,
    Case,
    arrays_for,
    color_stream,
    fill_folder,
    header_of,
    noise,
    seal_again,
    write_arrays,
    write_packed_file,
)
from tests.reference_packed import decode_code, decode_color

SMALL = Case(n_splats=200, n_dictionary=3, cliplines=True, ellipsoids=True, size_bits=3)
MANY_GROUPS = Case(n_splats=9 * GROUP + 500, cliplines=True, period=128)  # in two zarr chunks of splats
MAPPED = Case(n_splats=300, n_dictionary=0, atom_counts=(0,), n_maps=2)
BOXED = Case(n_splats=300, n_dictionary=3, atom_counts=(0, 1, 9, 16), n_ranks=16, color_step=112)
WALKED = Case(n_splats=300, atom_counts=(0, 2), n_dictionary=3, runs=True)
CURVED = Case(n_splats=300, atom_counts=(0, 2), n_dictionary=3, quadrics=True)
HUGE, NOT_A_NUMBER = 2**60, float("nan")
MANY_BOXED = replace(MANY_GROUPS, cliplines=False, color_step=112)


@pytest.fixture(autouse=True)
def no_waiting_for_the_disk(monkeypatch):
    """Hundreds of crafted files are sealed here, and none has to outlive a power cut."""
    monkeypatch.setattr(os, "fsync", lambda file: None)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    return write_packed_file(SMALL, tmp_path_factory.mktemp("packed") / "small.splatpress")


@pytest.fixture(scope="module")
def boxed(tmp_path_factory):
    return write_packed_file(BOXED, tmp_path_factory.mktemp("packed") / "boxed.splatpress")


@pytest.fixture(scope="module")
def walked(tmp_path_factory):
    return write_packed_file(WALKED, tmp_path_factory.mktemp("packed") / "walked.splatpress")


@pytest.fixture(scope="module")
def curved(tmp_path_factory):
    return write_packed_file(CURVED, tmp_path_factory.mktemp("packed") / "curved.splatpress")


@pytest.fixture(scope="module")
def archived(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(transcode, "LEAST_GROUPS", 1)  # so that it has models
        return write_packed_file(replace(SMALL, archive=True), tmp_path_factory.mktemp("packed") / "a.splatpress")


@pytest.fixture(scope="module")
def small_arrays(small):
    with PackedFile(small) as opened:
        return opened.load().arrays


@pytest.fixture(scope="module")
def many_groups(tmp_path_factory):
    return write_packed_file(MANY_GROUPS, tmp_path_factory.mktemp("packed") / "many.splatpress")


def read_whole(path, verify=True) -> PackedScene:
    with PackedFile(path, verify) as opened:
        return opened.load()


def spread(low: int, high: int, n: int) -> list[int]:
    """`n` places in low..high that fall on every residue."""
    return sorted({low + int(x) for x in noise(n, 77, high - low)})


def same_arrays(found: dict, expected: dict) -> bool:
    return found.keys() == expected.keys() and all(np.array_equal(found[name], expected[name]) for name in expected)


# --- what is written comes back --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "case",
    [
        Case(),
        SMALL,
        Case(n_splats=1),
        Case(n_splats=128),
        Case(dictionary_bits=16, weight_bits=8, n_dictionary=260),
        Case(dictionary_bits=6, atom_size=8, n_turns=8),
        Case(n_dictionary=0, atom_counts=(0,), n_cameras=0),
        Case(n_dictionary=0, atom_counts=(0,), cliplines=True),
        Case(atom_counts=(0,)),
        BOXED,
        Case(n_splats=1, color_step=80),
        Case(n_splats=1, size_bits=2),
        Case(n_splats=300, size_bits=4),
        Case(n_dictionary=0, atom_counts=(0,), n_cameras=0, color_step=255),
        MAPPED,
    ],
)
def test_packed__header_and_arrays_come_back(case, tmp_path):
    header = header_of(case)
    arrays = arrays_for(case, header)
    scene = read_whole(write_arrays(header, arrays, tmp_path / "a.splatpress"))
    assert scene.header == header
    assert same_arrays(scene.arrays, arrays)
    stored = {array.name: array.dtype for array in arrays_of(header) if array.name not in TABLE}
    assert {name: str(scene.arrays[name].dtype) for name in stored} == stored


def test_packed__chunks_of_zeros_are_written_like_others(tmp_path):
    header = replace(header_of(SMALL), cameras=header_of(SMALL).cameras[:1])
    arrays = arrays_for(SMALL, header) | {"camera": np.zeros(200, np.uint16), "color": np.zeros((200, 3), np.uint8)}
    assert same_arrays(read_whole(write_arrays(header, arrays, tmp_path / "a.splatpress")).arrays, arrays)


@pytest.mark.parametrize("case", [SMALL, BOXED])
def test_packed__codes_are_those_of_the_slow_twin(case, tmp_path):
    scene = read_whole(write_packed_file(case, tmp_path / "a.splatpress"))
    atom, weight = scene.codes()
    for splat in range(scene.header.n_splats):
        expected = decode_code(scene, splat)
        assert scene.n_atoms[splat] == len(expected)
        assert list(zip(atom[splat], weight[splat])) == expected + [(0, 0)] * (case.n_ranks - len(expected))


def test_packed__colours_in_boxes_are_those_of_the_slow_twin(boxed):
    scene = read_whole(boxed)
    found = decoded_colors(scene)
    for splat in range(scene.header.n_splats):
        np.testing.assert_allclose(found[splat] / 255, decode_color(scene, splat), atol=1e-6)
    assert len(np.unique(found, axis=0)) > 150 and found.min() == 0 and found.max() == 255


def test_packed__codes_of_a_range_are_a_part_of_all(many_groups):
    scene = read_whole(many_groups)
    part = slice(GROUP - 100, GROUP + 100)
    for some, all_of_them in zip(scene.codes(part.start, part.stop), scene.codes()):
        assert (some == all_of_them[part]).all()


def test_packed__scan_without_texture_has_codes_of_no_atoms(tmp_path):
    path = write_packed_file(Case(n_dictionary=0, atom_counts=(0,), n_cameras=0), tmp_path / "a.splatpress")
    atom, weight = read_whole(path).codes()
    assert atom.shape == weight.shape == (300, 8)
    assert atom.dtype == weight.dtype == np.int32
    assert not atom.any() and not weight.any()


def test_packed__rows_are_read_as_slices_are(small, small_arrays):
    with PackedFile(small) as opened:
        for start, stop in ((0, None), (3, 9), (190, 400), (50, 50), (-5, None)):
            assert np.array_equal(opened.read("position", start, stop), small_arrays["position"][start:stop])


def test_packed__an_array_that_a_file_has_not_is_the_callers_mistake(small):
    with PackedFile(small) as opened, pytest.raises(KeyError):
        opened.read("colour")


# --- random access ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("index", [0, 1, 8, 9])
def test_packed__a_group_alone_is_what_it_is_in_the_whole(many_groups, index):
    whole = read_whole(many_groups)
    with PackedFile(many_groups, verify=False) as opened:
        part = opened.group(index)
    splats = slice(index * GROUP, (index + 1) * GROUP)
    assert part.header.n_splats == len(whole.arrays["position"][splats])
    assert (part.arrays["position"] == whole.arrays["position"][splats]).all()
    assert (part.arrays["box_low"] == whole.arrays["box_low"][index * 64 : (index + 1) * 64]).all()
    assert (part.rows.clipline == whole.rows.clipline[splats]).all()
    for some, all_of_them in zip(part.codes(), whole.codes()):
        assert (some == all_of_them[splats]).all()


@pytest.mark.parametrize("index", [0, 7, 8, 9])
def test_packed__a_group_alone_has_the_colours_that_it_has_in_the_whole(tmp_path, index):
    path = write_packed_file(MANY_BOXED, tmp_path / "a.splatpress")
    with PackedFile(path) as opened:
        part, whole = opened.group(index), opened.load()
    assert (decoded_colors(part) == decoded_colors(whole)[index * GROUP : (index + 1) * GROUP]).all()


@pytest.mark.parametrize("case", [MANY_GROUPS, MANY_BOXED])
def test_packed__a_group_is_read_without_the_zarr_chunks_of_others(case, tmp_path):
    def ruin(members):
        for name in members:
            if name.split("/")[0] in in_groups and name.split("/")[1:2] == ["c"] and name.split("/")[2] != "7":
                members[name] = b"~" * len(members[name])

    in_groups = {array.name for array in ARRAYS if array.in_groups}
    path = craft(write_packed_file(case, tmp_path / "whole.splatpress"), tmp_path / "a.splatpress", ruin)
    with PackedFile(path) as opened:
        opened.group(7)
        for ruined in (0, 6, 8, 9):
            with pytest.raises(InvalidPackedFile):
                opened.group(ruined)


@pytest.mark.parametrize("index", [-1, 10])
def test_packed__there_is_no_group_beyond_the_last(many_groups, index):
    with PackedFile(many_groups) as opened, pytest.raises(IndexError, match="of 10"):
        opened.group(index)


def test_packed__no_verification_reads_no_more_than_it_needs(many_groups, monkeypatch):
    monkeypatch.setattr(packed, "check_seal", lambda path: pytest.fail("the whole file was read"))
    with PackedFile(many_groups, verify=False) as opened:
        assert opened.header == header_of(MANY_GROUPS)


# --- sealing ---------------------------------------------------------------------------------------------------------


def test_packed__same_contents_make_the_same_bytes(small, tmp_path):
    again = write_packed_file(SMALL, tmp_path / "elsewhere.splatpress")
    assert again.read_bytes() == small.read_bytes()


def places_in(path) -> dict[str, tuple[int, int]]:
    """Where the bytes of each member's local header and contents begin and end."""
    with zipfile.ZipFile(path) as archive:
        return {
            i.filename: (i.header_offset, i.header_offset + 30 + len(i.filename) + i.file_size)
            for i in archive.infolist()
        }


def test_packed__a_group_is_one_range_of_the_file_where_the_table_says(many_groups):
    places = places_in(many_groups)
    with PackedFile(many_groups) as opened:
        table = opened.groups
    for group in range(10):
        of_group = [
            place
            for name, place in places.items()
            if "/c/" in name and BY_NAME[name.split("/")[0]].in_groups and name.split("/")[2] == str(group)
        ]
        first, last = min(of_group)[0], max(of_group)[1]
        assert (first, last - first) == (table.start[group], table.bytes[group])
        assert sum(stop - start for start, stop in of_group) == last - first


def test_packed__begins_with_the_table_and_the_coarsest_level(tmp_path):
    case = replace(MANY_GROUPS, n_splats=2 * GROUP + 9 * GROUP + 500)
    header = replace(header_of(case), levels=(2 * GROUP, 9 * GROUP + 500))
    names = list(places_in(write_arrays(header, arrays_for(case, header), tmp_path / "a.splatpress")))
    kinds = [name.split("/")[0] if "/c/" not in name else (name.split("/")[0], name.split("/")[2]) for name in names]
    first = {kind: i for i, kind in reversed(list(enumerate(kinds)))}
    order = [first[k] for k in ("zarr.json", "normal", ("group_seal", "0"), ("position", "0"), ("position", "1"))]
    order += [first[k] for k in (("atoms_32", "0"), ("position", "2"), ("position", "11"))]
    assert order == sorted(order)


def test_packed__the_table_says_what_a_group_shows(many_groups):
    with PackedFile(many_groups) as opened:
        table, scene = opened.groups, opened.load()
    low, size = scene.arrays["box_low"].astype(float), scene.arrays["box_size"]
    normal = decode_normals(scene.arrays["normal"])
    for group in range(10):
        chunks, splats = slice(64 * group, 64 * group + 64), slice(GROUP * group, GROUP * group + GROUP)
        assert (table.low[group] == low[chunks].min(axis=0)).all()
        assert (table.high[group] >= (low + size)[chunks].max(axis=0)).all()
        radius = scene_radii(scene)[splats]
        by_area = np.average(radius, weights=radius**2)
        assert np.allclose(table.radius[group], [by_area, radius.max()])
        axis, cosine = table.cone[group, :3] / np.linalg.norm(table.cone[group, :3]), table.cone[group, 3] / 127
        assert (normal[splats] @ axis).min() >= cosine > (normal[splats] @ axis).min() - 0.02 or cosine == -1


def test_packed__a_cone_is_as_narrow_as_the_normals_are(tmp_path):
    header = header_of(SMALL)
    level = np.tile(np.array([[3, -2]], np.int8), (200, 1))
    path = write_arrays(header, arrays_for(SMALL, header) | {"normal": level}, tmp_path / "a.splatpress")
    with PackedFile(path) as opened:
        assert opened.groups.cone[0, 3] >= 126


@pytest.mark.parametrize(
    "field, value, match",
    [
        ("low", [0.0, 0.0, -1e9], "group_low"),
        ("high", [NOT_A_NUMBER] * 3, "group_high is not finite"),
        ("cone", [0, 0, 127, 127], "group_cone"),
        ("radius", [9.0, 9.0], "group_radius"),
        ("rows", [2**31] * 3, "group_rows"),
        ("rows", [3, 3, 3], "group_rows"),
        ("bytes", 7, "group_bytes"),
        ("seal", [0] * 32, "seal"),
    ],
)
def test_packed__a_table_of_groups_that_lies_is_refused(tmp_path, field, value, match):
    header = header_of(SMALL)
    folder = tmp_path / "folder"
    fill_folder(header, arrays_for(SMALL, header), folder, lambda groups: [replace(groups[0], **{field: value})])
    seal_packed(folder, tmp_path / "a.splatpress")
    assert_refused(tmp_path / "a.splatpress", match=match)


def test_packed__a_group_whose_bytes_were_altered_is_refused_alone(many_groups, tmp_path):
    data = bytearray(many_groups.read_bytes())
    start, stop = places_in(many_groups)["color/c/3/0"]
    data[stop - 40] ^= 1
    (tmp_path / "a.splatpress").write_bytes(data)
    with PackedFile(tmp_path / "a.splatpress", verify=False) as opened:
        opened.group(2)
        with pytest.raises(InvalidPackedFile):
            opened.group(3)


def test_packed__the_order_of_writing_leaves_no_trace(small, tmp_path):
    header = header_of(SMALL)
    backwards = dict(reversed(arrays_for(SMALL, header).items()))
    assert write_arrays(header, backwards, tmp_path / "a.splatpress").read_bytes() == small.read_bytes()


def test_packed__leavings_of_a_killed_task_stay_out(small, tmp_path):
    fill_folder(header_of(SMALL), arrays_for(SMALL, header_of(SMALL)), tmp_path / "folder")
    (tmp_path / "folder" / "groups" / "000000.7f3a.partial").write_bytes(b"half a piece")
    seal_packed(tmp_path / "folder", tmp_path / "a.splatpress")
    assert (tmp_path / "a.splatpress").read_bytes() == small.read_bytes()


@pytest.mark.parametrize("lost", ["groups/000000", "groups/000000.told", "codes/zarr.json", "atoms_1/c/0/0/0/0"])
def test_packed__what_was_never_written_is_not_laid_out(tmp_path, lost):
    fill_folder(header_of(SMALL), arrays_for(SMALL, header_of(SMALL)), tmp_path / "folder")
    (tmp_path / "folder" / lost).unlink()
    with pytest.raises(InternalError, match=lost.split("/")[0]):
        lay_out(tmp_path / "folder", header_of(SMALL))
        seal_packed(tmp_path / "folder", tmp_path / "a.splatpress")
    assert os.listdir(tmp_path) == ["folder"]


@pytest.mark.parametrize("lost", ["before", "directory", "places.json"])
def test_packed__what_was_never_laid_out_is_not_sealed(tmp_path, lost):
    fill_folder(header_of(SMALL), arrays_for(SMALL, header_of(SMALL)), tmp_path / "folder")
    (tmp_path / "folder" / lost).unlink()
    with pytest.raises(InternalError, match="never"):
        seal_packed(tmp_path / "folder", tmp_path / "a.splatpress")
    assert os.listdir(tmp_path) == ["folder"]


def test_packed__a_seal_that_fails_leaves_the_old_file_and_no_other(small, tmp_path, monkeypatch):
    def full_disk(*_):
        raise OSError("no space left on device")

    fill_folder(header_of(SMALL), arrays_for(SMALL, header_of(SMALL)), tmp_path / "folder")
    (tmp_path / "a.splatpress").write_bytes(b"old")
    monkeypatch.setattr(joined, "end_with_seal", full_disk)
    with pytest.raises(OSError, match="no space"):
        seal_packed(tmp_path / "folder", tmp_path / "a.splatpress")
    assert sorted(os.listdir(tmp_path)) == ["a.splatpress", "folder"]
    assert (tmp_path / "a.splatpress").read_bytes() == b"old"


def test_packed__is_told_from_other_files_by_its_end(small, tmp_path):
    (tmp_path / "short").write_bytes(b"ply")
    (tmp_path / "long").write_bytes(b"ply" * 100)
    assert is_packed_file(small)
    assert not any(is_packed_file(tmp_path / name) for name in ("short", "long", "none", "."))


@pytest.mark.parametrize("array", ARRAYS, ids=lambda array: array.name)
def test_packed__zarr_writes_the_metadata_that_the_layout_says(array, tmp_path):
    header = header_of(
        BOXED if array.name == "colors" else {RUNS: WALKED, QUADRICS: CURVED}.get(FORMS.get(array.name), SMALL)
    )
    created = create_array(zarr.open_group(str(tmp_path), mode="w"), header, array)
    assert json.loads((tmp_path / array.name / "zarr.json").read_bytes()) == metadata_of(array, created.shape)


# --- truncated and altered -------------------------------------------------------------------------------------------


def test_packed__refuses_every_truncation(small, tmp_path):
    data = small.read_bytes()
    path = tmp_path / "a.splatpress"
    for length in [*range(len(data) - 1024, len(data)), *spread(0, len(data) - 1024, 200), 0]:
        path.write_bytes(data[:length])
        with pytest.raises(InvalidPackedFile):
            PackedFile(path)


def test_packed__refuses_every_truncation_without_verification_too(small, tmp_path):
    data = small.read_bytes()
    path = tmp_path / "a.splatpress"
    for length in [*range(len(data) - SEAL_BYTES, len(data)), *spread(0, len(data), 50)]:
        path.write_bytes(data[:length])
        with pytest.raises(InvalidPackedFile):
            read_whole(path, verify=False)


@pytest.mark.parametrize("extra", [b"\0", b"PK\5\6", b"x" * 100])
@pytest.mark.parametrize("at_end", [True, False])
def test_packed__refuses_extra_bytes(small, tmp_path, extra, at_end):
    data = small.read_bytes()
    (tmp_path / "a.splatpress").write_bytes(data + extra if at_end else extra + data)
    with pytest.raises(InvalidPackedFile):
        PackedFile(tmp_path / "a.splatpress")


def test_packed__refuses_every_flipped_byte(small, tmp_path):
    data = small.read_bytes()
    path = tmp_path / "a.splatpress"
    for place in [*spread(0, len(data), 250), *range(len(data) - SEAL_BYTES, len(data))]:
        path.write_bytes(data[:place] + bytes([data[place] ^ 1 << place % 8]) + data[place + 1 :])
        with pytest.raises(InvalidPackedFile):
            PackedFile(path)


def test_packed__a_damaged_file_with_a_right_seal_is_refused_or_reads_the_same(small, small_arrays, tmp_path):
    data = small.read_bytes()
    path = tmp_path / "a.splatpress"
    directory = struct.unpack("<I", data[-SEAL_BYTES - 6 : -SEAL_BYTES - 2])[0]
    refused = 0
    for place in [*spread(0, directory, 150), *spread(directory, len(data) - SEAL_BYTES - 4, 250)]:
        path.write_bytes(data[:place] + b"\xff\xff\xff\xff" + data[place + 4 :])
        seal_again(path)
        try:
            assert same_arrays(read_whole(path).arrays, small_arrays)
        except InvalidPackedFile:
            refused += 1
    assert refused > 200


def test_packed__says_that_other_files_are_no_packed_files(tmp_path):
    (tmp_path / "a.ply").write_bytes(b"ply\nformat ascii 1.0\n" * 50)
    with pytest.raises(InvalidPackedFile, match="a.ply: no packed file"):
        PackedFile(tmp_path / "a.ply")


def test_packed__a_file_that_is_not_there_is_no_damage(tmp_path):
    with pytest.raises(FileNotFoundError):
        PackedFile(tmp_path / "none.splatpress")


# --- crafted, with a right seal --------------------------------------------------------------------------------------


def tell_places(members):
    """Let the table of groups say where members lie now, that something else is found to be wrong."""
    at, places = 0, {}
    for name, data in members.items():
        array, *rest = name.split("/")
        stop = at + 30 + len(name) + len(data)
        if array in BY_NAME and BY_NAME[array].in_groups and rest[0] == "c":
            start, _ = places.setdefault(int(rest[1]), (at, stop))
            places[int(rest[1])] = start, stop
        at = stop
    for name, values in (("start", [p[0] for p in places.values()]), ("bytes", [q - p for p, q in places.values()])):
        if f"group_{name}/c/0" in members:
            members[f"group_{name}/c/0"] = np.array(values, "<u8").tobytes()


def craft(source, target, edit, compress=()):
    """A copy of a packed file whose members (name -> bytes) went through `edit`, sealed again."""
    with zipfile.ZipFile(source) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    edit(members)
    tell_places(members)
    with zipfile.ZipFile(target, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data, zipfile.ZIP_DEFLATED if name in compress else zipfile.ZIP_STORED)
        archive.comment = UNSEALED
    seal_again(target)
    return target


def craft_json(source, target, member, edit):
    """A copy of which one JSON member went through `edit`."""

    def edit_members(members):
        data = json.loads(members[member])
        edit(data)
        members[member] = json.dumps(data).encode()

    return craft(source, target, edit_members)


def assert_refused(path, match="."):
    for verify in (True, False):
        with pytest.raises(InvalidPackedFile, match=match):
            read_whole(path, verify)


def test_packed__a_crafted_copy_without_edits_is_fine(small, small_arrays, tmp_path):
    path = craft(small, tmp_path / "a.splatpress", lambda members: None)
    assert same_arrays(read_whole(path).arrays, small_arrays)


@pytest.mark.parametrize(
    "field, value",
    [
        ("format", "otherpress"),
        ("format", None),
        ("version", 0),
        ("version", 2),
        ("version", "1"),
        ("version", True),
        ("version", 1.0),
        ("n_splats", 0),
        ("n_splats", -1),
        ("n_splats", 201),
        ("n_splats", 199),
        ("n_splats", HUGE),
        ("n_splats", 200.0),
        ("n_splats", "200"),
        ("n_splats", True),
        ("n_splats", 10**400),
        ("radius", NOT_A_NUMBER),
        ("radius", float("inf")),
        ("radius", 0),
        ("radius", -1.0),
        ("radius", "0.25"),
        ("radius", 10**400),
        ("radius", None),
        ("size_bits", 1),
        ("size_bits", 2),
        ("size_bits", 0),
        ("size_bits", True),
        ("size_bits", HUGE),
        ("unit", 7),
        ("origin", [0, 0]),
        ("origin", [0, 0, NOT_A_NUMBER]),
        ("origin", "abc"),
        ("origin", [0, 0, "1"]),
        ("origin", 5),
        ("up", [0, 0, 0]),
        ("up", [37, 0, 0]),
        ("up", [1.0, 0, 0]),
        ("up", [True, 0, 0]),
        ("up", [0, 1]),
        ("up", 2),
        ("up", [HUGE, 0, 0]),
        ("ahead", [0, 0, 0]),
        ("ahead", [0, 0, 1]),
        ("ahead", [0, 21, 35]),
        ("ahead", [1, 0, 37]),
        ("ahead", None),
        ("margin_radii", NOT_A_NUMBER),
        ("margin_radii", float("inf")),
        ("margin_radii", -1),
        ("n_dictionary", 0),
        ("n_dictionary", -1),
        ("n_dictionary", 4),
        ("n_dictionary", 257),
        ("n_dictionary", HUGE),
        ("dictionary_bits", -1),
        ("dictionary_bits", 1),
        ("dictionary_bits", 17),
        ("dictionary_bits", HUGE),
        ("atom_size", 16),
        ("atom_size", 64),
        ("atom_size", 0),
        ("atom_size", HUGE),
        ("n_turns", 0),
        ("n_turns", 2),
        ("n_turns", -8),
        ("n_turns", 8.0),
        ("n_turns", HUGE),
        ("n_ranks", 0),
        ("n_ranks", 7),
        ("n_ranks", 9),
        ("n_ranks", 17),
        ("n_ranks", HUGE),
        ("n_ranks", 8.0),
        ("n_ranks", None),
        ("color_step", 79),
        ("color_step", 112),
        ("color_step", 256),
        ("color_step", -1),
        ("color_step", HUGE),
        ("color_step", 0.5),
        ("color_step", True),
        ("coarsest_size", 0),
        ("coarsest_size", 2),
        ("coarsest_size", 3),
        ("coarsest_size", 64),
        ("coarsest_size", True),
        ("coarsest_size", None),
        ("weight_bits", 0),
        ("weight_bits", 9),
        ("weight_bits", 5),
        ("weight_bits", HUGE),
        ("weight_bits", "4"),
        ("batches", []),
        ("batches", {}),
        ("batches", [{"n_atoms": 9, "clipline": False}]),
        ("batches", [{"n_atoms": -1, "clipline": False}]),
        ("batches", [{"n_atoms": 1}]),
        ("batches", [1, 2]),
        ("batches", [{"n_atoms": 1, "clipline": False, "ellipsoid": 1}]),
        ("batches", [{"n_atoms": 1, "clipline": True, "ellipsoid": True}]),
        ("batches", [{"n_atoms": 1, "clipline": 0}]),
        ("batches", [{"n_atoms": 1, "clipline": False}] * 2),
        ("cameras", None),
        ("cameras", []),
        ("cameras", [{}]),
        ("cameras", "photo"),
        ("scan", "tiny"),
        ("settings", []),
    ],
)
def test_packed__refuses_header_fields_out_of_their_range(small, tmp_path, field, value):
    def edit(data):
        data["attributes"][field] = value

    assert_refused(craft_json(small, tmp_path / "a.splatpress", "zarr.json", edit))


@pytest.mark.parametrize(
    "field, value",
    [
        ("n_splats", 0),
        ("radius", -1.0),
        ("margin_radii", -1.0),
        ("dictionary_bits", 17),
        ("weight_bits", 9),
        ("n_dictionary", 257),
    ],
)
def test_packed__names_the_header_field_that_is_out_of_its_range(small, tmp_path, field, value):
    def edit(data):
        data["attributes"][field] = value

    assert_refused(craft_json(small, tmp_path / "a.splatpress", "zarr.json", edit), match=f"{field} {value}, not ")


@pytest.mark.parametrize(
    "field, value",
    [
        ("fx_px", NOT_A_NUMBER),
        ("fx_px", "500"),
        ("width_px", 0),
        ("height_px", -5),
        ("width_px", 1.5),
        ("name", 3),
        ("rotation", [[1, 0, 0]]),
        ("rotation", [[1, 0, 0], [0, 1, 0], [0, 0, float("inf")]]),
        ("rotation", "abc"),
        ("centre", [1, 2]),
        ("centre", [1, 2, NOT_A_NUMBER]),
    ],
)
def test_packed__refuses_cameras_of_odd_numbers(small, tmp_path, field, value):
    def edit(data):
        data["attributes"]["cameras"][1][field] = value

    assert_refused(craft_json(small, tmp_path / "a.splatpress", "zarr.json", edit))


def test_packed__refuses_whole_numbers_in_place_of_truth_values(small, tmp_path):
    def edit(data):
        data["attributes"]["batches"][0]["clipline"] = 0

    assert_refused(craft_json(small, tmp_path / "a.splatpress", "zarr.json", edit), match="clipline is 0")


def test_packed__a_second_set_of_metadata_is_never_believed(small, small_arrays, tmp_path):
    def consolidate(members):
        root = json.loads(members["zarr.json"])
        metadata = {name: json.loads(members[f"{name}/zarr.json"]) for name in small_arrays if name in BY_NAME}
        metadata["color"]["data_type"] = "int8"
        root["consolidated_metadata"] = {"kind": "inline", "must_understand": False, "metadata": metadata}
        members["zarr.json"] = json.dumps(root).encode()

    path = craft(small, tmp_path / "a.splatpress", consolidate)
    found = read_whole(path).arrays
    assert found["color"].dtype == np.uint8 and same_arrays(found, small_arrays)


@pytest.mark.parametrize("field", sorted(header_of(SMALL).to_json()))
def test_packed__refuses_a_header_without_one_of_its_fields(small, tmp_path, field):
    path = craft_json(small, tmp_path / "a.splatpress", "zarr.json", lambda data: data["attributes"].pop(field))
    assert_refused(path)


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"[]",
        b"null",
        b"{",
        b"\xff\xfe",
        b"[" * 100_000,
        b'{"attributes":' * 5000,
        b'{"attributes": []}',
        b'{"attributes": {"format": "splatpress", "version": ' + b"9" * 10_000 + b"}}",
    ],
)
@pytest.mark.parametrize("member", ["zarr.json", "position/zarr.json", "codes/zarr.json"])
def test_packed__refuses_json_that_is_no_header(small, tmp_path, member, text):
    assert_refused(craft(small, tmp_path / "a.splatpress", lambda members: members.update({member: text})))


@pytest.mark.parametrize(
    "field, value",
    [
        ("shape", [200, 4]),
        ("shape", [200]),
        ("shape", [HUGE, 3]),
        ("shape", []),
        ("shape", None),
        ("data_type", "float64"),
        ("data_type", "int8"),
        ("data_type", {"name": "raw_bytes", "configuration": {"length_bytes": HUGE}}),
        ("chunk_grid", {"name": "regular", "configuration": {"chunk_shape": [HUGE, 3]}}),
        ("chunk_grid", {"name": "regular", "configuration": {"chunk_shape": [0, 3]}}),
        ("codecs", [{"name": "bytes"}]),
        ("codecs", [{"name": "bytes"}, {"name": "gzip", "configuration": {"level": 1}}]),
        ("fill_value", 255),
        ("node_type", "group"),
        ("zarr_format", 2),
        ("dimension_names", ["3", "n"]),
        ("storage_transformers", [{"name": "x"}]),
        ("must_understand_this", {}),
    ],
)
def test_packed__refuses_arrays_of_another_form(small, tmp_path, field, value):
    edit = {field: value}
    assert_refused(craft_json(small, tmp_path / "a.splatpress", "position/zarr.json", lambda data: data.update(edit)))


@pytest.mark.parametrize("n_words", [0, 1, -1, HUGE, 2560.0, "9", True, None])
def test_packed__refuses_word_streams_of_another_length(small, tmp_path, n_words):
    edit = {"shape": [1, n_words]}
    assert_refused(craft_json(small, tmp_path / "a.splatpress", "codes/zarr.json", lambda data: data.update(edit)))


@pytest.fixture(scope="module")
def mapped(tmp_path_factory):
    return write_packed_file(MAPPED, tmp_path_factory.mktemp("packed") / "mapped.splatpress")


def one_with(name: str, small, boxed, walked, mapped, curved, archived):
    """A file that has an array."""
    if name in ARCHIVE:
        return archived
    if FORMS.get(name) == QUADRICS:
        return curved
    if name.startswith("run_"):
        return walked
    if BY_NAME[name].part == "maps":
        return mapped
    return boxed if name.startswith("color") and name != "color" else small


@pytest.mark.parametrize("name", [array.name for array in ARRAYS])
def test_packed__refuses_a_missing_array(small, boxed, walked, mapped, curved, archived, tmp_path, name):
    def drop(members):
        for member in [m for m in members if m.startswith(name + "/")]:
            del members[member]

    assert_refused(
        craft(one_with(name, small, boxed, walked, mapped, curved, archived), tmp_path / "a.splatpress", drop)
    )


@pytest.mark.parametrize("name", [array.name for array in ARRAYS])
def test_packed__refuses_a_missing_chunk(small, boxed, walked, mapped, curved, archived, tmp_path, name):
    def drop(members):
        del members[next(m for m in members if m.startswith(name + "/c/"))]

    assert_refused(
        craft(one_with(name, small, boxed, walked, mapped, curved, archived), tmp_path / "a.splatpress", drop),
        match="members",
    )


@pytest.mark.parametrize("renamed", ["position/c/1/0", "position/c/0/1", "../position", "/position/c/0/0"])
def test_packed__refuses_a_chunk_under_another_name(small, tmp_path, renamed):
    def rename(members):
        members[renamed] = members.pop("position/c/0/0")

    assert_refused(craft(small, tmp_path / "a.splatpress", rename), match="unknown")


def test_packed__refuses_members_that_no_array_has(small, tmp_path):
    path = craft(small, tmp_path / "a.splatpress", lambda members: members.update(readme=b"hello"))
    assert_refused(path, match="members")


def test_packed__refuses_members_that_are_there_twice(small, tmp_path):
    with zipfile.ZipFile(small) as source, zipfile.ZipFile(tmp_path / "a.splatpress", "w") as archive:
        with pytest.warns(UserWarning, match="Duplicate"):
            for name in [*source.namelist(), "color/c/0/0"]:
                archive.writestr(name, source.read(name))
        archive.comment = UNSEALED
    seal_again(tmp_path / "a.splatpress")
    assert_refused(tmp_path / "a.splatpress", match="there twice")


@pytest.mark.parametrize("member", ["zarr.json", "color/zarr.json", "color/c/0/0"])
def test_packed__refuses_compressed_members(small, tmp_path, member):
    path = craft(small, tmp_path / "a.splatpress", lambda members: None, compress=[member])
    assert_refused(path, match="is compressed")


def edit_directory_entry(path, name: str, place: int, field: bytes) -> None:
    """Overwrite bytes of a member's entry in the zip's directory, and seal again."""
    data = bytearray(path.read_bytes())
    entry = data.rindex(name.encode()) - 46
    assert data[entry : entry + 4] == b"PK\1\2"
    data[entry + place : entry + place + len(field)] = field
    path.write_bytes(data)
    seal_again(path)


@pytest.mark.parametrize(
    "place, field",
    [
        (8, b"\1\0"),
        (8, b"\x41\0"),
        (8, b"\0\x08"),
        (10, b"\x08\0"),
        (10, b"\x0c\0"),
        (24, b"\1\0\0\0"),
        (20, b"\1\0\0\0"),
    ],
)
def test_packed__refuses_members_that_are_not_plainly_stored(small, tmp_path, place, field):
    path = craft(small, tmp_path / "a.splatpress", lambda members: None)
    edit_directory_entry(path, "color/c/0/0", place, field)
    assert_refused(path, match="is compressed, encrypted")


@pytest.mark.parametrize(
    "place, field",
    [
        (20, b"\xff" * 8),
        (20, b"\xf0\xff\xff\xff" * 2),
        (42, b"\xf0\xff\xff\xff"),
        (42, b"\xff" * 4),
        (30, b"\xff\xff"),
    ],
)
def test_packed__refuses_zip_entries_that_lie(small, tmp_path, place, field):
    path = craft(small, tmp_path / "a.splatpress", lambda members: None)
    edit_directory_entry(path, "color/c/0/0", place, field)
    assert_refused(path)


def test_packed__refuses_members_that_share_their_bytes(tmp_path):
    path = tmp_path / "a.splatpress"
    with zipfile.ZipFile(path, "w") as archive:
        for i in range(50):
            archive.writestr(f"member-{i:02d}", b"x" * 100_000 if i == 0 else b"")
        archive.comment = UNSEALED
    for i in range(1, 50):
        edit_directory_entry(path, f"member-{i:02d}", 20, struct.pack("<II", 100_000, 100_000))
    assert_refused(path, match="members of 5000000 bytes")


@pytest.mark.parametrize("claimed", [2**40, 2**63, 200 * 3 - 1, 200 * 3 + 1, 0])
def test_packed__takes_no_memory_that_a_chunk_only_claims(small, tmp_path, claimed):
    def bomb(members):
        members["color/c/0/0"] = b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", claimed) + b"\1\0\0"

    path = craft(small, tmp_path / "a.splatpress", bomb)
    with PackedFile(path) as opened:
        tracemalloc.start()
        with pytest.raises(InvalidPackedFile, match=f"a chunk of {claimed} bytes"):
            opened.read("color")
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < 10_000_000


@pytest.mark.parametrize(
    "chunk",
    [
        b"",
        b"\x28\xb5\x2f\xfd",
        b"\x50\x2a\x4d\x18\0\0\0\0",
        b"raw" * 200,
        Zstd().encode(b"x" * 599),
        Zstd().encode(b"x" * 600)[:-2],
        Zstd().encode(b"x" * 600) + b"more",
    ],
)
def test_packed__refuses_chunks_that_are_not_one_frame_of_their_size(small, tmp_path, chunk):
    path = craft(small, tmp_path / "a.splatpress", lambda members: members.update({"color/c/0/0": chunk}))
    assert_refused(path)


@pytest.mark.parametrize("n_bytes", [0, 1, 255, 256, 257, 65_535, 65_791, 65_792, 70_000, 1_000_000])
def test_packed__frame_sizes_are_read_as_zstd_writes_them(n_bytes):
    frame = Zstd(level=9).encode(noise(n_bytes, 1, 256).astype(np.uint8).tobytes())
    check_frame(frame[:18], n_bytes)
    with pytest.raises(ValueError, match=f"a chunk of {n_bytes} bytes"):
        check_frame(frame[:18], n_bytes + 1)


def changed(name, place, value):
    """An edit of one value of one array."""

    def edit(arrays):
        arrays[name][place] = value

    return pytest.param(edit, id=f"{name}-{value}")


def longer(name):
    def edit(arrays):
        arrays[name] = np.append(arrays[name], np.uint32(0))

    return pytest.param(edit, id=f"{name}-longer")


@pytest.mark.parametrize(
    "edit",
    [
        changed("box_low", (1, 2), np.nan),
        changed("box_size", (0, 0), np.inf),
        changed("box_size", (0, 1), -1),
        changed("box_bits", (1, 0), 25),
        changed("box_bits", (1, 1), 255),
        changed("normal", (5, 1), -128),
        changed("batch_count", (0, 0), 129),
        changed("batch_count", (1, 3), 0),
        changed("batch_count", 0, 255),
        changed("codes", 0, 2**32 - 1),
        changed("camera", 9, 2),
        changed("camera", 9, 65534),
        longer("codes"),
        longer("cliplines"),
        changed("size_scale", (0, 0), 255),
        longer("ellipsoids"),
        changed("batch_count", (0, 9), 128),
    ],
)
def test_packed__refuses_tables_that_do_not_fit(tmp_path, edit):
    header = header_of(SMALL)
    arrays = arrays_for(SMALL, header)
    edit(arrays)
    path = write_arrays(header, arrays, tmp_path / "a.splatpress")
    assert_refused(path)
    with pytest.raises(InvalidPackedFile), PackedFile(path) as opened:
        opened.group(0)


@pytest.mark.parametrize(
    "edit",
    [
        changed("color_size", (0, 0), 255),
        changed("color_size", (2, 1), 80),
        longer("colors"),
    ],
)
def test_packed__refuses_boxes_of_colours_that_do_not_fit(tmp_path, edit):
    header = header_of(BOXED)
    arrays = arrays_for(BOXED, header)
    arrays["color_size"][[0, 2]] = [[200, 180, 180], [120, 130, 120]]
    arrays |= color_stream(arrays["color_size"], header)
    read_whole(write_arrays(header, arrays, tmp_path / "sound.splatpress"))
    edit(arrays)
    path = write_arrays(header, arrays, tmp_path / "a.splatpress")
    assert_refused(path, match="colors")
    with PackedFile(path) as opened, pytest.raises(InvalidPackedFile, match="colors"):
        opened.group(0)


def test_packed__refuses_colours_of_more_bits_than_a_shader_reads(tmp_path):
    header = header_of(replace(BOXED, color_step=80))
    arrays = arrays_for(BOXED, header)
    for size, fine in ((240, True), (241, False)):
        arrays["color_size"][1] = size
        path = write_arrays(
            header, arrays | color_stream(arrays["color_size"], header), tmp_path / f"{size}.splatpress"
        )
        if fine:
            assert len(read_whole(path).color_cells) == 300
        else:
            assert_refused(path, match="colours of 33 bits a splat, more than 30")


@pytest.mark.parametrize(
    "edit",
    [
        changed("weight_levels", (7, 3), np.nan),
        changed("atom_scale", 1, np.inf),
        changed("atoms_8", (2, 3, 4, 1), -128),
    ],
)
def test_packed__refuses_dictionaries_of_odd_numbers(tmp_path, edit):
    header = header_of(SMALL)
    arrays = arrays_for(SMALL, header)
    edit(arrays)
    assert_refused(write_arrays(header, arrays, tmp_path / "a.splatpress"))


@pytest.mark.parametrize("count", [[[127], [72]], [[128], [73]], [[128], [0]]])
def test_packed__refuses_counts_that_do_not_add_up_where_no_codes_depend_on_them(tmp_path, count):
    case = Case(n_splats=200, n_dictionary=0, atom_counts=(0,), n_cameras=0)
    header = header_of(case)
    arrays = arrays_for(case, header) | {"batch_count": np.array(count, np.uint8)}
    assert_refused(write_arrays(header, arrays, tmp_path / "a.splatpress"), match="batch_count")


def test_packed__batches_that_are_alike_are_refused(tmp_path):
    header = replace(header_of(SMALL), batches=(Batch(1), Batch(3), Batch(1)))
    path = write_arrays(header, arrays_for(SMALL, header), tmp_path / "a.splatpress")
    assert_refused(path, match="batches .*different from each other")


@pytest.mark.parametrize(
    "changed, what",
    [
        ({"height_px": 24}, "whole 16 rows"),
        ({"height_px": 4096}, "whole 16 rows"),
        ({"nearest": 0.0}, "finite"),
        ({"depth_step": -0.005}, "finite"),
        ({"centre": (0.0, float("inf"), 0.0)}, "finite"),
        ({"color_bytes": 0}, "finite"),
        ({"color_bytes": HUGE}, "members"),
    ],
)
def test_packed__refuses_maps_of_odd_numbers(tmp_path, changed, what):
    header = header_of(MAPPED)
    arrays = arrays_for(MAPPED, header)
    path = write_arrays(header, arrays, tmp_path / "a.splatpress")
    odd = replace(header, maps=(replace(header.maps[0], **changed), *header.maps[1:]))
    path = craft_json(path, tmp_path / "b.splatpress", "zarr.json", lambda data: data.update(attributes=odd.to_json()))
    assert_refused(path, match=what)


def test_packed__refuses_a_station_beyond_the_maps_and_maps_beside_a_dictionary(tmp_path):
    header = header_of(MAPPED)
    arrays = arrays_for(MAPPED, header) | {"station": np.full(300, 2, np.uint8)}
    assert_refused(write_arrays(header, arrays, tmp_path / "a.splatpress"), match="station beyond the 2 maps")
    both = replace(MAPPED, n_dictionary=5)
    assert_refused(write_packed_file(both, tmp_path / "b.splatpress"), match="none beside a dictionary")


def test_packed__atoms_without_a_dictionary_are_refused(tmp_path):
    header = replace(header_of(Case(n_dictionary=0, atom_counts=(0, 1))), batches=(Batch(0), Batch(1)))
    path = write_arrays(header, arrays_for(Case(n_dictionary=0, atom_counts=(0, 1)), header), tmp_path / "a.splatpress")
    assert_refused(path, match="no dictionary")


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="counts open files by /proc")
def test_packed__a_failed_open_leaves_no_file_open(small, tmp_path):
    damaged = [
        craft(small, tmp_path / "a.splatpress", lambda members: members.update({"zarr.json": b"{"})),
        craft(small, tmp_path / "b.splatpress", lambda members: members.pop("color/c/0/0")),
        craft_json(small, tmp_path / "c.splatpress", "zarr.json", lambda data: data.update(zarr_format=2)),
        tmp_path / "d.splatpress",
    ]
    damaged[-1].write_bytes(small.read_bytes()[:-SEAL_BYTES])
    before = len(os.listdir("/proc/self/fd"))
    for path in damaged:
        assert_refused(path)
    assert len(os.listdir("/proc/self/fd")) == before


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="counts open files by /proc")
def test_packed__closing_leaves_no_file_open(small):
    before = len(os.listdir("/proc/self/fd"))
    with PackedFile(small) as opened:
        opened.load()
        assert len(os.listdir("/proc/self/fd")) > before
    assert len(os.listdir("/proc/self/fd")) == before  # while `opened` still lives


def test_packed__header_is_the_same_after_json():
    header = header_of(SMALL)
    assert Header.from_json(json.loads(json.dumps(header.to_json()))) == header
