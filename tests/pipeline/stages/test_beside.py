"""Stages that the catalogue runs by itself: a row and a file are all there is of one."""

import dataclasses
import inspect
from pathlib import Path

from pipeline.catalogue import CATALOGUE, Phase, StageEntry, Task
from pipeline.effects.block import Sources
from pipeline.effects.plan.plan import EffectPlan
from pipeline.planning.settings import Settings
from pipeline.stages import beside
from pipeline.stages.beside import Given, module_of, stages_beside, work_arrays
from storage.work.schema import WORK_ARRAYS, WorkArray

GIVEN = Given(Settings(), Sources(*(Path("x"),) * 5, 1.0, (0, 0, 1), (1, 0, 0)), EffectPlan((), {}))


def test_beside__only_rows_that_say_so_have_a_stage_to_ask_for_and_no_other_stage_reads_it():
    assert {e.name for e in CATALOGUE if hasattr(module_of(e), "asked")} == {e.name for e in CATALOGUE if e.beside}
    assert not {e.name for e in CATALOGUE if e.beside} & {name for e in CATALOGUE for name in e.reads}
    for entry in CATALOGUE:
        if entry.beside:
            assert list(inspect.signature(module_of(entry).asked).parameters) == ["given"]


def test_beside__a_row_of_the_catalogue_is_enough(monkeypatch):
    @dataclasses.dataclass(frozen=True)
    class Heights:
        partition: Path
        name = "heights"

    class File:
        ARRAYS = (WorkArray("height", "float32", ("n",), ("heights",), "above the lowest point"),)

        @staticmethod
        def asked(given: Given) -> Heights:
            return Heights(given.sources.partition)

    row = StageEntry("heights", "stages/points/heights.py", Phase.FILE, Task.BLOCK, "heights", beside=True)
    plain = StageEntry("others", "stages/points/others.py", Phase.FILE, Task.BLOCK, "others")
    monkeypatch.setattr(beside, "import_module", {"pipeline.stages.points.heights": File}.__getitem__)
    assert stages_beside(GIVEN, (row, plain)) == [Heights(Path("x"))]
    assert work_arrays((row, plain)) == (*WORK_ARRAYS, *File.ARRAYS)


def test_beside__what_a_job_does_not_call_for_is_not_made():
    assert {stage.name for stage in stages_beside(GIVEN)} == {e.name for e in CATALOGUE if e.beside and not e.when}
