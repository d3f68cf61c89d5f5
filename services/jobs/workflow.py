"""One job as a durable DBOS workflow: a step a stage, a step an iteration of k-SVD.

A runner that dies is started again and goes on with the first step that has no recorded outcome; of that stage only
the tasks without a recorded result run. What a job made is committed only while its attempt is the one that is wanted.
"""

from __future__ import annotations

import shutil
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from dbos import DBOS
from sqlalchemy.exc import SQLAlchemyError

from pipeline.catalogue import PICTURES, RENDER
from pipeline.execution.calls import error_of_disk
from pipeline.execution.stage import Stage, StageRecord
from pipeline.planning.settings import Settings
from pipeline.stages.points.ingest import Ingest
from pipeline.stages.texture.dictionary import KsvdUpdate
from renderer.report.document import ViewMeasured
from services.flow.previews import previews_of
from services.flow.run import Run
from services.jobs.cluster import GL
from services.jobs.disk import check_room, drop_ballast, take_ballast
from services.jobs.elsewhere import call_with_files
from services.jobs.progress import JobProgress
from services.jobs.scheduler import SchedulerLink
from services.problems import is_of_database, problem_of_job
from services.processes.compress import make
from services.processes.kinds import PERFORMANCE, TRADEOFF
from services.processes.tradeoff import measure_ladder
from services.settings import ServiceSettings
from services.store.rows import FAILED, SUCCESSFUL, ArtifactRow, JobRow
from services.store.store import Store
from services.uploads.scans import file_hash, scan_path, work_folder
from storage import place
from storage.work.stage_lock import stage_lock
from storage.work.work import stage_folder, write_json

BUCKET_LOOK_S = 1.0  # a request each
LEARNING = "learning.json"


class Dismissed(Exception):
    """The job is no longer wanted."""


def job_folder(settings: ServiceSettings, id: str) -> Path:
    """Where all attempts of a job leave what they make."""
    return settings.place / "jobs" / id


def made_folder(settings: ServiceSettings, id: str, attempt: int) -> Path:
    """Where the runner writes what an attempt makes: none writes into another's. Where results lie in a bucket, its own
    copy of that folder."""
    return settings.data / "jobs" / id / f"attempt-{attempt}"


def dismissal_token(settings: ServiceSettings, id: str, attempt: int) -> Path:
    """The file whose presence stops an attempt; cheap to look for, also on another machine."""
    return job_folder(settings, id) / f"dismissed-{attempt}"


class JobRunner:
    """Runs jobs on one scheduler; `scheduler()` gives the address that is good now."""

    def __init__(self, settings: ServiceSettings, store: Store, scheduler: Callable[[], str]) -> None:
        self.settings, self.store, self.scheduler = settings, store, scheduler

    def run(self, id: str, attempt: int) -> str:
        """The body of the workflow. Every ending of a job is committed here."""
        take_ballast(self.settings.data)
        job = self.store.job(id)
        if job is None or job.attempt != attempt or not self.store.begin(id, attempt):
            return "not wanted"
        out = made_folder(self.settings, id, attempt)
        out.mkdir(parents=True, exist_ok=True)
        there = job_folder(self.settings, id) / out.name
        try:
            place.bring_folder(there, out)
            self._make_though_the_database_may_go(job, out, there)
            made = self._kept(out, there)
        except Dismissed:
            self.store.log(id, "warning", f"attempt {attempt}: dismissed; what it made so far stays")
            self.store.keep_artifacts(id, attempt, self._kept(out, there))
            return "dismissed"
        except Exception as error:
            drop_ballast(self.settings.data)  # the disk may be full
            said = f"attempt {attempt}: {type(error).__name__}: {error}"
            self.store.log(id, "error", self._as_its_owner_calls_it(job, said))
            self.store.log(id, "debug", traceback.format_exc()[-4000:])
            problem = problem_of_job(error)
            problem["detail"] = self._as_its_owner_calls_it(job, problem["detail"])
            self.store.end(id, attempt, FAILED, self._kept_if_it_can(out, there), problem)
            return "failed"
        self.store.end(id, attempt, SUCCESSFUL, made)
        if out != there:
            shutil.rmtree(out.parent, ignore_errors=True)
        return "successful"

    def _as_its_owner_calls_it(self, job: JobRow, said: str) -> str:
        """With the owner's name of the scan in place of where it lies here."""
        scan = self.store.scan(job.scan, job.owner)
        return said if scan is None else said.replace(str(scan_path(self.settings, scan)), scan.file)

    def _kept(self, out: Path, there: Path) -> list[ArtifactRow]:
        """The artifacts, in their place."""
        place.put_folder(out, there)
        return artifacts_in(out)

    def _kept_if_it_can(self, out: Path, there: Path) -> list[ArtifactRow]:
        """Those of a job that failed, perhaps because its place is full or away."""
        try:
            return self._kept(out, there)
        except OSError:
            return []

    def _make_though_the_database_may_go(self, job: JobRow, out: Path, there: Path) -> None:
        """Again where a step's end could not be noted: what the step did is on disk, and found there."""
        while True:
            try:
                return self._make(job, out, there)
            except SQLAlchemyError as error:
                if not is_of_database(error) or is_of_database(error, full=True):
                    raise
                self.store.log(
                    job.id, "warning", "the database was away at the end of a step; going on"
                )  # once it is back

    def _make(self, job: JobRow, out: Path, there: Path) -> None:
        check = self._check_of(job)
        n_cameras = self.store.scan(job.scan).header["cameras"]["count"]
        progress = JobProgress(self.store, job, check, textured=bool(n_cameras))
        work = work_folder(self.settings, job.scan)
        place.make_folder(work)
        scan = scan_path(self.settings, self.store.scan(job.scan))
        owned = self.store.scan(job.scan, job.owner)
        file = owned.file if owned else job.name
        link = SchedulerLink(
            self.scheduler, self.store, job.id, check, out / PERFORMANCE, self.settings.performance_from_s
        )
        run = Run(work, link, progress)

        def step(stage: Stage, do: Callable[[], StageRecord]) -> StageRecord:
            def bring_about() -> StageRecord:
                check_room(self.settings, stage.name)
                with stage_lock(stage_folder(work, stage), check):
                    return do()

            record = DBOS.run_step({"name": stage.name}, bring_about)
            progress.passed(record)
            if stage.name == Ingest.name:
                bounds = {"min": record.summary.low, "max": record.summary.high}
                self.store.note_of_scan(job.scan, job.owner, bounds=bounds)
            if stage.name == KsvdUpdate.name:
                write_json(out / LEARNING, progress.learning)
            return record

        def draw(packed: Path, ingest: Path, folder: Path, on_view: Callable[[int, int], None]) -> list[ViewMeasured]:
            previews = folder / "previews"

            def count() -> None:
                done = len(list(previews.glob("*.packed.png"))) if previews.is_dir() else 0
                if done:
                    on_view(done, max(done, min(12, n_views or done)))

            def on_gl_worker() -> list[ViewMeasured]:
                check_room(self.settings, "render")
                files = (packed, ingest, folder)
                return call_with_files(link, out, there, RENDER, previews_of, *files, resources=GL, meanwhile=count)

            n_views = n_cameras or 4
            return DBOS.run_step({"name": RENDER}, on_gl_worker)

        def paint(function: Callable, *arguments):
            check_room(self.settings, PICTURES)

            def on_gl_worker():
                return call_with_files(link, out, there, RENDER, function, *arguments, resources=GL)

            return DBOS.run_step({"name": PICTURES}, on_gl_worker)

        run.step, run.draw, run.paint, run.round = step, draw, paint, progress.round
        run.clock = lambda: DBOS.run_step(
            {"name": "clock"}, time.time
        )  # what depends on it must come out the same again
        try:
            with link:
                self._run_process(run, scan, file, job, out)
        except OSError as error:  # between the tasks: the packed file, the report
            raise error_of_disk(progress.stage, error) from error
        check()

    def _run_process(self, run: Run, scan: Path, file: str, job: JobRow, out: Path) -> None:
        settings = Settings(**job.settings)
        if job.process == TRADEOFF:
            measure_ladder(run, scan, out, settings, job.knobs, job.budget_s, name=file)
        else:
            effects = make(run, scan, settings, out, name=Path(file).stem)["effects"]
            self.store.note_of_scan(job.scan, job.owner, effects=effects)

    def _check_of(self, job: JobRow) -> Callable[[], None]:
        token = dismissal_token(self.settings, job.id, job.attempt)

        every_s, looked = BUCKET_LOOK_S if place.is_remote(token) else 0.0, float("-inf")

        def check() -> None:
            nonlocal looked
            if time.monotonic() - looked < every_s:
                return
            looked = time.monotonic()
            if place.is_file(token):
                raise Dismissed

        return check


def artifacts_in(out: Path) -> list[ArtifactRow]:
    """What lies in an attempt's folder whole, with its hash."""
    files = [p for p in sorted(out.rglob("*")) if p.is_file() and not p.name.endswith(".partial")]
    return [
        ArtifactRow(p.relative_to(out).as_posix(), p.relative_to(out.parent).as_posix(), p.stat().st_size, file_hash(p))
        for p in files
    ]
