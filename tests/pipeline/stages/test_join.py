"""A packed file that tasks put together: the bytes that one process writes, whoever died on the way."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from benchmarks.patches import Silent
from pipeline.execution.executors import SerialExecutor
from pipeline.execution.stage import run_stage
from pipeline.stages.packed import join
from pipeline.stages.packed.join import FILE, Join, Written, hand_over
from services.flow import pack as flow
from services.flow.run import Run
from storage.packed.writing import joined
from storage.packed.writing.joined import seal_packed
from storage.work import work
from tests.packed_files import Case, arrays_for, fill_folder, header_of

CASE = Case(n_splats=2000, cliplines=True, n_dictionary=3)


@pytest.fixture(scope="module")
def packed(tmp_path_factory) -> tuple[Path, bytes]:
    pack = tmp_path_factory.mktemp("work") / "pack-0123456789abcdef"
    fill_folder(header_of(CASE), arrays_for(CASE, header_of(CASE)), pack / "packed")
    seal_packed(pack / "packed", pack.parent / "whole")
    return pack, (pack.parent / "whole").read_bytes()


@pytest.fixture(autouse=True)
def small_ranges(monkeypatch):
    monkeypatch.setattr(join, "RANGE", 4099)
    monkeypatch.setattr(joined, "BLOCK", 1000)


@dataclass(frozen=True)
class Dying(Join):
    """Its third task dies half-way, once."""

    def run(self, folder: Path, index: int) -> Written:
        if index == 2 and not (folder / "died").exists():
            (folder / "died").touch()
            joined.write_range(self.pack / "packed", folder / FILE, 2 * join.RANGE, 2 * join.RANGE + 1500)
            raise KeyboardInterrupt
        return super().run(folder, index)


class Backwards(SerialExecutor):
    def run(self, stage, folder, indices, on_done):
        super().run(stage, folder, indices[::-1], on_done)


def test_join__order_repeats_and_a_task_that_died_leave_no_trace(packed, tmp_path):
    pack, whole = packed
    with pytest.raises(KeyboardInterrupt):
        run_stage(Dying(pack), tmp_path, SerialExecutor(), Silent())
    record = run_stage(Dying(pack), tmp_path, Backwards(), Silent())
    assert record.n_tasks > 5 and record.summary.n_bytes == len(whole) - join.SEAL_BYTES
    stage, folder = Join(pack), record.folder
    assert (folder / FILE).read_bytes() == whole
    stage.run(folder, 1)  # of a worker that was given up
    stage.finalise(folder, [])
    assert (folder / FILE).read_bytes() == whole


def test_join__a_file_is_handed_over_and_made_again_for_the_next(packed, tmp_path, monkeypatch):
    pack, whole = packed
    monkeypatch.setattr(flow, "is_joined_by_all", lambda *_: True)
    run = Run(tmp_path / "work", SerialExecutor(), Silent())
    record = type("Packed", (), {"folder": pack, "summary": type("Summary", (), {"bytes": {}})})
    for name in ("a", "b"):
        flow.write_packed(run, record, tmp_path / name)
        assert (tmp_path / name).read_bytes() == whole
    joined_folder = work.stage_folder(run.work, Join(pack))
    assert not (joined_folder / FILE).exists()
    hand_over(pack, joined_folder, tmp_path / "a")  # after a restart: it is there
    hand_over(pack, joined_folder, tmp_path / "c")  # or is lost
    assert (tmp_path / "c").read_bytes() == whole


def test_join__on_another_disk_it_is_copied_whole(packed, tmp_path, monkeypatch):
    pack, whole = packed
    folder = run_stage(Join(pack), tmp_path, SerialExecutor(), Silent()).folder

    def elsewhere(source, target):
        raise OSError("Invalid cross-device link")

    monkeypatch.setattr(join.os, "rename", elsewhere)
    hand_over(pack, folder, tmp_path / "a")
    assert (tmp_path / "a").read_bytes() == whole and not (folder / FILE).exists()
