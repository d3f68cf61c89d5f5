"""A job's progress as the service tells it: percent, stage, splats a second, seconds left, PSNR so far."""

from __future__ import annotations

import time
from collections.abc import Callable

from pipeline.catalogue import RENDER
from pipeline.execution.stage import StageRecord
from pipeline.stages.texture.dictionary import KsvdUpdate
from pipeline.stages.texture.training import TrainingSet
from pipeline.summaries import Training
from services.flow.textures import estimated_psnr_db
from services.jobs.portion import Portion
from services.store.rows import JobRow
from services.store.store import Store

TELL_EVERY_S = 0.5
FIRST_ESTIMATE = 3  # percent; before that a guess of the time left says nothing


class JobProgress:
    """Hears of the stages (`pipeline.execution.stage.Progress`) and tells the store, at most every TELL_EVERY_S.

    `check` is called whenever something happens, and raises once the job is no longer wanted. `textured`: whether the
    scan has photographs.
    """

    def __init__(self, store: Store, job: JobRow, check: Callable[[], None], textured: bool) -> None:
        self._store, self._id, self._attempt, self._check = store, job.id, job.attempt, check
        self._portion = Portion(job.settings["iterations"], textured)
        self._begun = self._told = time.monotonic()
        self.stage, self._n_tasks, self._n_done, self._n_splats, self._stage_begun = "", 1, 0, 0, self._begun
        self._training: Training | None = None
        self._first: float | None = None  # percent when this attempt began: what earlier ones did took it no time
        self._psnr_db: float | None = None
        self.learning: list[dict] = []

    def begin(self, name: str, n_tasks: int) -> None:
        self._check()
        self.stage, self._n_tasks, self._n_done, self._n_splats = name, max(1, n_tasks), 0, 0
        self._stage_begun = time.monotonic()
        self._tell()

    def advance(self, name: str, n_tasks: int, n_splats: int) -> None:
        self._check()
        self._n_done, self._n_splats = self._n_done + n_tasks, self._n_splats + n_splats
        if time.monotonic() - self._told > TELL_EVERY_S:
            self._tell()

    def end(self, record: StageRecord) -> None:
        self._check()
        how = (
            "reused" if record.reused else f"{record.seconds:.1f} s, {record.n_tasks} task{'s' * (record.n_tasks != 1)}"
        )
        self._store.log(self._id, "info", f"{record.name}: {how}")
        if not record.reused:
            self._store.count_stage(record.name, record.seconds, record.n_splats)
        if record.name == RENDER:
            self.passed(record)

    def passed(self, record: StageRecord) -> None:
        """A stage is done, now or by an earlier runner."""
        self._portion.passed(record.name)
        if record.name == TrainingSet.name:
            self._training = record.summary
        if record.name == KsvdUpdate.name and not record.summary.as_coded:
            self._psnr_db = estimated_psnr_db(self._training, record.summary)
            self.learning.append(
                {
                    "iteration": len(self.learning) + 1,
                    "psnr_db": self._psnr_db,
                    "replaced_atoms": record.summary.n_replaced,
                }
            )
            self._store.note_learning(self._id, self.learning[-1])
        self.stage, self._n_done = record.name, 0
        self._tell()

    def round(self, index: int, n_rounds: int) -> None:
        """Point `index` of `n_rounds` of a trade-off begins."""
        self._portion.round(index, n_rounds)

    def _tell(self) -> None:
        self._told = now = time.monotonic()
        percent = min(99.0, 100 * self._portion.at(self.stage, self._n_done / self._n_tasks))
        self._first = percent if self._first is None else self._first
        gone = percent - self._first
        left = (now - self._begun) * (100 - percent) / gone if gone >= FIRST_ESTIMATE else None
        rate = self._n_splats / (now - self._stage_begun) if self._n_splats and now > self._stage_begun else None
        self._store.note_progress(
            self._id,
            self._attempt,
            int(percent),
            self.stage,
            {
                "splats_per_second": rate and round(rate),
                "seconds_left": left and round(left, 1),
                "psnr_db": self._psnr_db,
            },
        )
