"""The table of the arrays of work folders: every stage that makes one stands there, and makes no other."""

from __future__ import annotations

from pipeline.catalogue import BY_NAME
from storage.work import arrays
from storage.work.schema import STAGES, WORK_ARRAYS, not_of_the_table

WITHOUT = {
    "iso-values",
    "measure-effects",
    "measure",
    "pack",
    "photo-pages",
    "map-pages",
    "station-light",
    "multipliers",
}
OF_OTHERS = {"sampled", "variant-errors"}  # rows of any other stage; none


def test_schema__has_every_stage_of_the_catalogue_that_makes_arrays():
    assert set(BY_NAME) - WITHOUT - OF_OTHERS == STAGES


def test_schema__says_each_thing_once():
    told = [(row.name, stage, row.dtype) for row in WORK_ARRAYS for stage in row.stages]
    assert len(set(told)) == len(told) and all(row.meaning for row in WORK_ARRAYS)


def test_schema__tells_an_array_that_it_does_not_have(tmp_path):
    for name, shape, dtype in (
        ("spacing", (9,), "float64"),
        ("normal", (9, 4), "float32"),
        ("degenerate", (9,), "bool"),
        ("gap", (9,), "bool"),
    ):
        arrays.create(tmp_path / "neighbours-0123456789abcdef", name, shape, dtype)
    assert [text.split()[1] for text in not_of_the_table(tmp_path)] == ["gap", "normal", "spacing"]
