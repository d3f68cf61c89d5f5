"""The runner: takes accepted jobs in order, runs them as DBOS workflows, and does what falls due beside them.

One runner a data folder: a second one waits until the first is gone. After a kill it finds its workflows again.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from dbos import DBOS, SetWorkflowID

from services.jobs.cluster import own_cluster
from services.jobs.disk import make_data_folder
from services.jobs.documents import job_document
from services.jobs.exports import make_next_export
from services.jobs.heartbeat import Heartbeat, show_dashboard, show_gone
from services.jobs.webhooks import deliver_due
from services.jobs.workflow import JobRunner, job_folder
from services.settings import ServiceSettings
from services.store.rows import JobRow
from services.store.store import Store
from services.store.tokens import forget_actions
from services.uploads.scans import discard_unused_scans
from storage import place

APPLICATION_VERSION = "2"  # raised when the steps of a job change; workflows of another version are not resumed
EXECUTOR_ID = "runner"
UNDER_WAY = ("PENDING", "ENQUEUED", "DELAYED")
POLL_S = 0.3
TIDY_EVERY_S = 60.0
EXPORT_POLL_S = 0.5
DATABASE_PATIENCE_S = 120.0  # of a database that is being started anew

_jobs: JobRunner | None = None


@DBOS.workflow(name="job")
def _job(id: str, attempt: int) -> str:
    return _jobs.run(id, attempt)


def run_forever(settings: ServiceSettings, stop: threading.Event | None = None) -> None:
    """Until SIGTERM or SIGINT; jobs under way go on at the next start."""
    global _jobs
    stop = stop or threading.Event()
    import pipeline.readers.colmap.library  # noqa: F401 (a thread that imported it could not give SIGTERM back)

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    make_data_folder(settings)
    # It ends by os._exit, see below: what its helper process then says of semaphores, which it cleans up, is no news
    os.environ["PYTHONWARNINGS"] = ",".join(filter(None, (os.environ.get("PYTHONWARNINGS"), "ignore:resource_tracker")))
    with ExitStack() as stack:
        if not _alone(stack, settings.place, stop):
            return
        store = Store(settings.database_url, DATABASE_PATIENCE_S)
        scheduler, dashboard = settings.scheduler, settings.dashboard_url
        if not scheduler:
            scheduler, dashboard = stack.enter_context(own_cluster(settings.workers, settings.data / "dask"))
        show_dashboard(settings.place, dashboard)
        _jobs = JobRunner(settings, store, lambda: scheduler)
        DBOS(config=dbos_config(settings))
        DBOS.launch()
        status = 1
        try:
            _serve(settings, store, stop, scheduler)
            status = 0
        except Exception as error:
            _complain(error)
        finally:
            show_gone(settings.place)
            # Not further: jobs under way would see their workers go, one by one, and count it as failure. As after a
            # kill, the next start goes on with them; the workers end with this process.
            os._exit(status)


def dbos_config(settings: ServiceSettings) -> dict:
    """The configuration of DBOS: its database, and the version that workflows must be of to go on."""
    url = settings.database_url
    if not settings.database:
        url = f"sqlite:///{settings.data / 'workflows.sqlite'}"
    return {
        "name": "splatpress",
        "system_database_url": url,
        "application_version": APPLICATION_VERSION,
        "executor_id": EXECUTOR_ID,
        "log_level": "ERROR",
        "console_log_level": "ERROR",
        "enable_otlp": False,
        "max_executor_threads": max(8, 4 * settings.jobs_at_once),
    }


def _alone(stack: ExitStack, folder: Path, stop: threading.Event) -> bool:
    attempt = stack.enter_context(place.try_alone(folder / "runner.lock"))
    while not stop.is_set():
        if attempt():
            return True
        stop.wait(POLL_S)
    return False


def _serve(settings: ServiceSettings, store: Store, stop: threading.Event, scheduler: str) -> None:
    threading.Thread(target=_beside, args=(settings, store, stop), daemon=True).start()
    threading.Thread(target=_export, args=(settings, store, stop, scheduler), daemon=True).start()
    found = DBOS.list_workflows(status=list(UNDER_WAY), app_version=APPLICATION_VERSION, load_input=False)
    under_way = {"-".join(w.workflow_id.split("-")[:2]): DBOS.retrieve_workflow(w.workflow_id) for w in found}
    for job in store.running_jobs():
        store.log(job.id, "warning", f"attempt {job.attempt}: the runner was started anew and goes on")
    heartbeat = Heartbeat(settings.place)
    while not stop.is_set():
        try:
            heartbeat.show()
            under_way = _look_after(settings, store, under_way)
        except Exception as error:  # most likely the database was away for longer than anyone had patience
            _complain(error)
        stop.wait(POLL_S)


def _look_after(settings: ServiceSettings, store: Store, under_way: dict) -> dict:
    """The workflows under way after one look at them and at the jobs; starts those that should be and are not."""
    store.note_absence()
    under_way = {id: handle for id, handle in under_way.items() if _is_under_way(handle)}
    for job in store.running_jobs():
        if _workflow_id(job) not in under_way:  # it could not write its end
            store.log(job.id, "warning", f"attempt {job.attempt}: ended without a word; it goes on")
            under_way[_workflow_id(job)] = _start(job, again=True)
    for job in store.waiting_jobs(settings.jobs_at_once):
        if len(under_way) < settings.jobs_at_once and _workflow_id(job) not in under_way:
            under_way[_workflow_id(job)] = _start(job)
    return under_way


def _complain(error: Exception) -> None:
    print(f"splatpress: {type(error).__name__}: {error}", file=sys.stderr, flush=True)


def _workflow_id(job: JobRow) -> str:
    return f"{job.id}-{job.attempt}"


def _start(job: JobRow, again: bool = False):
    """Starting the same attempt twice starts it once: the workflow's name says which it is."""
    with SetWorkflowID(_workflow_id(job) + (f"-{time.time_ns()}" if again else "")):
        return DBOS.start_workflow(_job, job.id, job.attempt)


def _is_under_way(handle) -> bool:
    return handle.get_status().status in UNDER_WAY


def _beside(settings: ServiceSettings, store: Store, stop: threading.Event) -> None:
    """Webhooks and retention, in a thread of their own: neither may hold up a job, nor end with an error."""
    tidied = float("-inf")
    while not stop.wait(1.0):
        _or_complain(deliver_due, settings, store, lambda job: job_document(job, settings))
        if time.monotonic() - tidied > TIDY_EVERY_S:
            tidied = time.monotonic()
            _or_complain(tidy, settings, store)


def _export(settings: ServiceSettings, store: Store, stop: threading.Event, scheduler: str) -> None:
    """Exports that are asked for, one after the other, in a thread of their own: a large one takes minutes."""
    while not stop.wait(EXPORT_POLL_S):
        _or_complain(make_next_export, settings, store, scheduler)


def _or_complain(what: Callable, *arguments) -> None:
    try:
        what(*arguments)
    except Exception as error:
        _complain(error)


def tidy(settings: ServiceSettings, store: Store) -> None:
    """Delete what has outlived its time. The row goes first: files without a row are harmless, a row without is not."""
    before = time.time() - settings.retention_s
    for job in store.expired_jobs(before):
        if store.forget_job(job.id):
            place.remove_folder(job_folder(settings, job.id))
    forget_actions(store, time.time() - settings.audit_s)
    store.disown_expired_scans(before)
    discard_unused_scans(settings, store)
    for upload in store.expired_uploads():
        store.forget_upload(upload.id)
        shutil.rmtree(settings.data / "uploads" / upload.id, ignore_errors=True)
