"""The table of the arrays of work folders: every stage that makes one stands there, and makes no other."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.catalogue import BY_NAME
from storage.work import arrays, work
from storage.work.schema import STAGES, WORK_ARRAYS, not_of_the_table


def test_schema__has_stages_of_the_catalogue_alone():
    assert set(BY_NAME) >= STAGES


def test_schema__says_each_thing_once():
    told = [(row.name, stage, row.dtype) for row in WORK_ARRAYS for stage in row.stages]
    assert len(set(told)) == len(told) and all(row.meaning for row in WORK_ARRAYS)


def test_schema__tells_an_array_that_it_does_not_have(tmp_path):
    folder = tmp_path / "neighbours-0123456789abcdef"
    for name, shape, dtype in (
        ("spacing", (9,), "float64"),
        ("normal", (9, 4), "float32"),
        ("degenerate", (9,), "bool"),
        ("gap", (9,), "bool"),
    ):
        arrays.create(folder, name, shape, dtype)
    assert [text.split()[1] for text in not_of_the_table(folder)] == ["gap", "normal", "spacing"]


def test_schema__is_held_wherever_a_test_completes_a_stage(tmp_path: Path):
    folder = tmp_path / "voxels-0123456789abcdef"
    work.begin(folder)
    arrays.create(folder, "gap", (9,), "bool")
    with pytest.raises(AssertionError, match="voxels: gap"):
        work.complete(folder, {}, 0.0)
