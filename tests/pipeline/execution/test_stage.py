"""Stages run once, resume where they stopped, and give the same under every executor."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

import numba
import numpy as np
import pytest

import pipeline.execution.task
from pipeline.execution.executors import DaskExecutor, SerialExecutor
from pipeline.execution.stage import run_stage
from pipeline.execution.task import CALL_S, run_tasks
from storage.errors import InvalidScan, ResourceExhausted
from storage.work import arrays, work


@dataclass(frozen=True)
class BlockSquared:
    """What a task tells."""

    n_splats: int
    total: int


@dataclass(frozen=True)
class Squares:
    """Task i writes the squares of its block; it fails, or dies, where `trap` has a file to say so."""

    n: int
    trap: str = ""
    name = "squares"
    location_fields = ("trap",)

    def init(self, folder: Path) -> int:
        arrays.create(folder, "square", (self.n,), "int64", (10,))
        return arrays.n_blocks(self.n, 10)

    def run(self, folder: Path, index: int) -> BlockSquared:
        if self.trap and index == 2:
            if Path(self.trap, "fail").exists():
                raise InvalidScan("squares:2", "a trap", "no trap")
            if Path(self.trap, "die").exists():
                os._exit(9)
        if self.trap:
            pipeline.execution.task.CALL_S = 0 if Path(self.trap, "hasty").exists() else CALL_S
            with open(Path(self.trap, "ran"), "a") as log:
                log.write(f"{index}\n")
        start, stop = arrays.block_range(index, self.n, 10)
        arrays.write(folder, "square", start, np.arange(start, stop) ** 2)
        return BlockSquared(stop - start, int((np.arange(start, stop) ** 2).sum()))

    def finalise(self, folder: Path, results: list[BlockSquared]) -> dict:
        return {"total": sum(r.total for r in results)}


@dataclass
class Heard:
    events: list = field(default_factory=list)

    def begin(self, name, n_tasks):
        self.events.append(("begin", name, n_tasks))

    def advance(self, name, n_tasks, n_splats):
        self.events.append(("advance", n_tasks, n_splats))

    def end(self, record):
        self.events.append(("end", record.n_splats, record.reused))


def test_stage__runs_every_task_once_and_is_not_run_again(tmp_path):
    heard = Heard()
    record = run_stage(Squares(45), tmp_path, SerialExecutor(), heard)
    assert record.summary == {"total": sum(i * i for i in range(45))}
    assert (arrays.read(record.folder, "square") == np.arange(45) ** 2).all()
    assert (record.n_tasks, record.n_splats, record.reused) == (5, 45, False)
    assert record.peak_rss_bytes > 1e6 and record.seconds > 0
    assert heard.events[0] == ("begin", "squares", 5) and heard.events[-1] == ("end", 45, False)
    assert run_stage(Squares(45), tmp_path, SerialExecutor(), heard).reused


@dataclass(frozen=True)
class Compiling:
    """Each task calls the same kernel, which the first one compiles."""

    name = "compiling"

    def init(self, folder: Path) -> int:
        self_made[:] = [numba.njit(lambda x: x + 1)]
        return 2

    def run(self, folder: Path, index: int) -> None:
        self_made[0](index)

    def finalise(self, folder: Path, results: list[None]) -> dict:
        return {}


self_made: list = []


def test_stage__a_task_tells_what_of_its_time_went_into_compiling(tmp_path):
    first, second = work.finished_tasks(run_stage(Compiling(), tmp_path, SerialExecutor(), Heard()).folder).values()
    assert 0 < first.compile_seconds <= first.seconds and second.compile_seconds == 0


def test_stage__another_parameter_is_another_folder(tmp_path):
    one, other = (run_stage(Squares(n), tmp_path, SerialExecutor(), Heard()) for n in (20, 30))
    assert one.folder != other.folder and one.summary != other.summary


def test_stage__after_a_failure_only_what_is_missing_runs(tmp_path):
    trap = tmp_path / "trap"
    trap.mkdir()
    (trap / "fail").touch()
    stage = Squares(45, str(trap))
    with pytest.raises(InvalidScan, match="squares:2: a trap; allowed: no trap"):
        run_stage(stage, tmp_path, SerialExecutor(), Heard())
    assert (trap / "ran").read_text().split() == ["0", "1"]
    (trap / "fail").unlink()
    record = run_stage(stage, tmp_path, SerialExecutor(), Heard())
    assert record.summary == {"total": sum(i * i for i in range(45))}
    assert (trap / "ran").read_text().split() == ["0", "1", "2", "3", "4"]


@pytest.fixture(scope="module")
def dask_executor():
    with DaskExecutor(n_workers=2) as executor:
        yield executor


def test_executors__dask_gives_what_the_loop_gives(tmp_path, dask_executor):
    heard = Heard()
    here = run_stage(Squares(95), tmp_path / "serial", SerialExecutor(), Heard())
    there = run_stage(Squares(95), tmp_path / "dask", dask_executor, heard)
    assert here.summary == there.summary and there.n_splats == 95
    assert (arrays.read(there.folder, "square") == np.arange(95) ** 2).all()
    assert sum(e[1] for e in heard.events if e[0] == "advance") == 10


@pytest.mark.parametrize("hasty", [False, True])
def test_executors__many_tasks_go_to_workers_by_the_handful_and_each_counts_once(hasty, tmp_path, dask_executor):
    if hasty:  # calls end after a task, and what is left of them is given out again
        (tmp_path / "hasty").touch()
    stage, heard = Squares(295, str(tmp_path)), Heard()
    found = run_stage(stage, tmp_path / "dask", dask_executor, heard)
    assert found.summary == {"total": sum(i * i for i in range(295))} and found.n_tasks == 30
    assert sorted(map(int, (tmp_path / "ran").read_text().split())) == list(range(30))
    assert [e[1] for e in heard.events if e[0] == "advance"][1:] == [1] * 30


def test_task__a_call_hands_back_what_it_has_no_time_for_and_does_nothing_twice(tmp_path, monkeypatch):
    stage = Squares(95, str(tmp_path))
    folder = run_stage(stage, tmp_path / "here", SerialExecutor(), Heard()).folder
    assert run_tasks(stage, folder, [3, 4]) == [work.finished_task(folder, i, BlockSquared) for i in (3, 4)]
    assert len((tmp_path / "ran").read_text().split()) == 10  # what is done is not done again
    monkeypatch.setattr("pipeline.execution.task.CALL_S", 0)
    assert run_tasks(stage, folder, [3, 4]) == [work.finished_task(folder, 3, BlockSquared)]


def test_executors__an_error_in_a_worker_arrives_as_itself(tmp_path, dask_executor):
    (tmp_path / "fail").touch()
    with pytest.raises(InvalidScan, match="squares:2: a trap"):
        run_stage(Squares(45, str(tmp_path)), tmp_path, dask_executor, Heard())


def test_executors__a_task_that_kills_its_workers_is_named(tmp_path):
    (tmp_path / "die").touch()
    with (
        DaskExecutor(n_workers=1) as executor,
        pytest.raises(ResourceExhausted, match=r"squares-\w+-1"),
    ):  # the call of task 2
        run_stage(Squares(45, str(tmp_path)), tmp_path, executor, Heard())


def test_work__json_is_whole_or_not_there(tmp_path):
    with pytest.raises(ValueError):
        work.write_json(tmp_path / "a.json", {"x": float("nan")})
    assert not list(tmp_path.iterdir())


def test_arrays__appended_rows_come_back_in_order(tmp_path):
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(1000, 3))
    writer = arrays.Appender(tmp_path, "rows", (3,), "float64", rows=64)
    for part in np.split(rows, np.sort(rng.integers(0, 1000, 20))):
        writer.append(part)
    assert writer.close() == 1000
    assert (arrays.read(tmp_path, "rows") == rows).all()
