"""Runs in a packed file: groups alone decode to what the whole file does; tables that do not fit are refused."""

from __future__ import annotations

import json
import zipfile

import numpy as np
import pytest

from pipeline.splats.decoded import scene_bounds, scene_normal_codes, scene_positions
from storage.errors import InvalidPackedFile
from storage.packed.packed import PackedFile
from storage.packed.schema import GROUP
from tests.packed_files import Case, arrays_for, header_of, write_arrays, write_packed_file

CASE = Case(n_splats=2 * GROUP + 130, period=128, atom_counts=(0, 1), n_dictionary=3, color_step=112, runs=True)


def test_runs__a_group_alone_decodes_as_in_the_whole_file(tmp_path):
    with PackedFile(write_packed_file(CASE, tmp_path / "a.splatpress")) as opened:
        whole = opened.load()
        for index in range(3):
            part, rows = opened.group(index), slice(index * GROUP, (index + 1) * GROUP)
            assert np.array_equal(scene_positions(part), scene_positions(whole)[rows])
            assert np.array_equal(scene_normal_codes(part), scene_normal_codes(whole)[rows])
    low, high = scene_bounds(whole)
    position = scene_positions(whole)
    assert np.array_equal(low[0], position[:128].min(axis=0)) and np.array_equal(high[-1], position[-2:].max(axis=0))
    assert len(low) == whole.header.n_chunks


TURN = [1, 0, 0, 0, 1, 0, 0, 0, 1]


def changed(name, at, value):
    def edit(arrays):
        arrays[name][at] = value

    return edit


@pytest.mark.parametrize(
    "edit",
    [
        changed("run_step", 5, 6),
        changed("run_batch", 9, 2),
        changed("run_codebook", (7, 1), -128),
        changed("run_normal", (0, 0), -128),
    ],
)
def test_runs__tables_that_do_not_fit_are_refused(edit, tmp_path):
    header = header_of(CASE)
    arrays = arrays_for(CASE, header)
    edit(arrays)
    path = write_arrays(header, arrays, tmp_path / "a.splatpress")
    with PackedFile(path) as opened:
        with pytest.raises(InvalidPackedFile):
            opened.load()
        with pytest.raises(InvalidPackedFile):
            for index in range(header.n_groups):
                opened.group(index)


@pytest.mark.parametrize(
    "edit",
    [
        {"geometry": "octrees"},
        {"runs": None},
        {"runs": {"cell": 0, "turn": TURN, "n_sections": 35, "n_runs": 1300}},
        {"runs": {"cell": 1e400, "turn": TURN, "n_sections": 35, "n_runs": 1300}},
        {"runs": {"cell": 0.7, "turn": [2.0] * 9, "n_sections": 35, "n_runs": 1300}},
        {"runs": {"cell": 0.7, "turn": TURN, "n_sections": 35, "n_runs": 2**62}},
        {"runs": {"cell": 0.7, "turn": TURN, "n_sections": 2, "n_runs": 1300}},
        {"levels": [GROUP, GROUP + 130]},
    ],
)
def test_runs__headers_that_do_not_fit_are_refused(edit, tmp_path):
    source = write_packed_file(CASE, tmp_path / "a.splatpress")
    with zipfile.ZipFile(source, "a") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    root = json.loads(members["zarr.json"])
    root["attributes"] |= edit
    members["zarr.json"] = json.dumps(root).encode()
    from tests.storage.packed.test_packed import craft

    path = craft(source, tmp_path / "b.splatpress", lambda found: found.update(members))
    with pytest.raises(InvalidPackedFile):
        PackedFile(path)
