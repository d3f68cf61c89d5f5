"""One job as a durable DBOS workflow: a step a stage, a step an iteration of k-SVD.

A runner that dies is started again and goes on with the first step that has no recorded outcome; of that stage only
the tasks without a recorded result run. What a job made is committed only while its attempt is the one that is wanted.
"""

from __future__ import annotations

import fcntl
import shutil
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from dbos import DBOS

from pipeline.executors import DaskExecutor
from pipeline.settings import Settings
from pipeline.stage import Stage, StageRecord
from services.cluster import CPU, GL, performance_report
from services.job_progress import JobProgress
from services.problems import problem_of_job
from services.rendering import previews_of
from services.scans import file_hash, scan_path, work_folder
from services.settings import ServiceSettings
from services.store import FAILED, SUCCESSFUL, Store
from services.workflow import Run, make
from storage.errors import ResourceExhausted
from storage.work import stage_folder, write_json

RECONNECT_S = 120.0  # how long a job waits for a scheduler that is gone
LOCK_POLL_S = 0.2
LEARNING, PERFORMANCE = "learning.json", "dask-performance.html"


class Dismissed(Exception):
    """The job is no longer wanted."""


def job_folder(settings: ServiceSettings, id: str) -> Path:
    return settings.data / "jobs" / id


def made_folder(settings: ServiceSettings, id: str, attempt: int) -> Path:
    """Where an attempt writes: none writes into another's."""
    return job_folder(settings, id) / f"attempt-{attempt}"


def dismissal_token(settings: ServiceSettings, id: str, attempt: int) -> Path:
    """The file whose presence stops an attempt; cheap to look for, also on another machine."""
    return job_folder(settings, id) / f"dismissed-{attempt}"


class JobRunner:
    """Runs jobs on one scheduler; `scheduler()` gives the address that is good now."""

    def __init__(self, settings: ServiceSettings, store: Store, scheduler: Callable[[], str]) -> None:
        self.settings, self.store, self.scheduler = settings, store, scheduler

    def run(self, id: str, attempt: int) -> str:
        """The body of the workflow. Every ending of a job is committed here."""
        job = self.store.job(id)
        if job is None or job["attempt"] != attempt or not self.store.begin(id, attempt):
            return "not wanted"
        out = made_folder(self.settings, id, attempt)
        out.mkdir(parents=True, exist_ok=True)
        try:
            self._make(job, out)
        except Dismissed:
            self.store.log(id, "warning", f"attempt {attempt}: dismissed; what it made so far stays")
            self.store.keep_artifacts(id, attempt, artifacts_in(out))
            return "dismissed"
        except Exception as error:
            self.store.log(id, "error", f"attempt {attempt}: {type(error).__name__}: {error}")
            self.store.log(id, "debug", traceback.format_exc()[-4000:])
            self.store.end(id, attempt, FAILED, artifacts_in(out), problem_of_job(error))
            return "failed"
        self.store.end(id, attempt, SUCCESSFUL, artifacts_in(out))
        return "successful"

    def _make(self, job: dict, out: Path) -> None:
        check = self._check_of(job)
        progress = JobProgress(self.store, job, check)
        work = work_folder(self.settings, job["scan"])
        work.mkdir(parents=True, exist_ok=True)
        scan = scan_path(self.settings, self.store.scan(job["scan"]))

        schedulers: list[str] = []  # those that this attempt has met

        def on_scheduler(what: Callable[[DaskExecutor], object]):
            return self._until_reached(job, check, schedulers, what)

        run = Run(work, _Lazily(on_scheduler), progress)

        def step(stage: Stage, do: Callable[[], StageRecord]) -> StageRecord:
            def bring_about() -> StageRecord:
                self._check_disk(stage.name)
                with _lock(stage_folder(work, stage), check):
                    return do()

            record = DBOS.run_step({"name": stage.name}, bring_about)
            progress.passed(record)
            if stage.name == "ksvd-update":
                write_json(out / LEARNING, progress.learning)
            return record

        def draw(packed: Path, ingest: Path, folder: Path, on_view: Callable[[int, int], None]) -> list[dict]:
            previews = folder / "previews"

            def count() -> None:
                done = len(list(previews.glob("*.packed.png"))) if previews.is_dir() else 0
                if done:
                    on_view(done, max(done, min(12, job_views or done)))

            def on_gl_worker() -> list[dict]:
                self._check_disk("render")
                return on_scheduler(lambda executor: executor.call(
                    "render", previews_of, packed, ingest, folder, resources=GL, meanwhile=count))

            job_views = self.store.scan(job["scan"])["header"]["cameras"]["count"] or 4
            return DBOS.run_step({"name": "render"}, on_gl_worker)

        run.step, run.draw = step, draw
        with performance_report(self.scheduler(), out / PERFORMANCE):
            make(run, scan, Settings(**job["settings"]), out)
        check()

    def _check_of(self, job: dict) -> Callable[[], None]:
        token = dismissal_token(self.settings, job["id"], job["attempt"])

        def check() -> None:
            if token.exists():
                raise Dismissed

        return check

    def _until_reached(self, job: dict, check: Callable[[], None], met: list[str], what: Callable[[DaskExecutor], object]):
        """`what`, again when the scheduler was lost meanwhile: all that was done is on disk, nothing in Dask.

        One that was lost between two stages only shows by another answering in its place: `met` lists those that did.
        """
        from concurrent.futures import CancelledError

        deadline = None
        while True:
            check()
            try:
                with DaskExecutor(scheduler=self.scheduler(), job=job["id"], resources=CPU, watch=check) as executor:
                    if met and met[-1] != executor.scheduler_id:
                        self.store.log(job["id"], "warning", "the scheduler was lost; going on with the one in its place")
                    met.append(executor.scheduler_id)
                    return what(executor)
            except (OSError, TimeoutError, CancelledError) as error:
                if isinstance(error, OSError) and error.errno is not None and not isinstance(error, ConnectionError):
                    raise  # a disk's, not a connection's
                deadline = deadline or time.monotonic() + RECONNECT_S
                if time.monotonic() > deadline:
                    raise ResourceExhausted("Dask", f"no scheduler for {RECONNECT_S:g} s ({type(error).__name__}: {error})") from error
                self.store.log(job["id"], "warning", f"no scheduler ({type(error).__name__}); going on when there is one")
                time.sleep(1)

    def _check_disk(self, stage: str) -> None:
        free, wanted = shutil.disk_usage(self.settings.data).free, self.settings.reserve_bytes
        if free < wanted:
            raise ResourceExhausted(f"stage {stage}", f"{free:,} bytes free on the disk of the data folder",
                                    f"at least {wanted:,}", "free some, then retry: what is done stays done")


class _Lazily:
    """An executor that reaches the scheduler only for a stage that has tasks to run."""

    n_workers = 1

    def __init__(self, on_scheduler: Callable) -> None:
        self._on_scheduler = on_scheduler

    def run(self, stage: Stage, folder: Path, indices: list[int], on_done: Callable[[int, dict], None]) -> None:
        missing = set(indices)

        def note(index: int, result: dict) -> None:
            missing.discard(index)
            on_done(index, result)

        if missing:
            self._on_scheduler(lambda executor: executor.run(stage, folder, sorted(missing), note))


@contextmanager
def _lock(folder: Path, check: Callable[[], None]) -> Iterator[None]:
    """One writer a stage's folder: jobs on the same scan share it. The kernel frees the lock of a process that died."""
    with open(folder.with_name(folder.name + ".lock"), "w") as lock:
        while True:
            check()
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                time.sleep(LOCK_POLL_S)
        yield


def artifacts_in(out: Path) -> list[dict]:
    """What lies in an attempt's folder whole, with its hash."""
    files = [p for p in sorted(out.rglob("*")) if p.is_file() and not p.name.endswith(".partial")]
    return [{"name": p.relative_to(out).as_posix(), "path": p.relative_to(out.parent).as_posix(),
             "bytes": p.stat().st_size, "sha256": file_hash(p)} for p in files]
