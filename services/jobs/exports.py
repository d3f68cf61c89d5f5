"""Exports of finished jobs: a worker makes each when it is first asked for, and it is kept as an artifact.

What is asked for stands in the database, so a runner that dies makes it when it is back; the same file gives the same
bytes.
"""

from __future__ import annotations

import traceback
from pathlib import Path

from pipeline.exports.formats import FORMATS
from services.jobs.disk import check_room
from services.jobs.elsewhere import call_there
from services.jobs.scheduler import SchedulerLink
from services.jobs.workflow import Dismissed, dismissal_token, job_folder
from services.problems import problem_of_job
from services.processes.export import export
from services.settings import ServiceSettings
from services.store.exports import export_name, fail_export, keep_export, packed_artifact, wanted_exports
from services.store.rows import ArtifactRow
from services.store.store import Store
from services.uploads.scans import file_hash
from storage import place


def make_next_export(settings: ServiceSettings, store: Store, scheduler: str) -> None:
    """The one that was asked for first, if any. Its failure is kept for whoever asks."""
    for wanted in wanted_exports(store, limit=1):
        job, format = wanted.job, wanted.format
        try:
            artifact = _made(settings, store, scheduler, job, format)
        except Exception as error:
            store.log(job, "error", f"export as {format}: {type(error).__name__}: {error}")
            store.log(job, "debug", traceback.format_exc()[-4000:])
            fail_export(store, job, format, problem_of_job(error))
        else:
            keep_export(store, job, format, artifact)


def _made(settings: ServiceSettings, store: Store, scheduler: str, job: str, format: str) -> ArtifactRow:
    folder, packed = job_folder(settings, job), packed_artifact(store, job)
    if packed is None:
        raise Dismissed
    name = export_name(packed, format)
    path = folder / name
    check_room(settings, "export")
    token = dismissal_token(settings, job, store.job(job).attempt)

    def check() -> None:
        if place.is_file(token):
            raise Dismissed

    with SchedulerLink(lambda: scheduler, store, job, check, Path(), float("inf")) as link:
        made = call_there(link, folder, "export", export, folder / packed.path, format, path)
    store.log(job, "info", f"export as {format}: {made.n_elements:,} {FORMATS[format].kind}, {made.n_bytes:,} bytes")
    for text in made.lost:
        store.log(job, "info", f"export as {format} loses {text}")
    return ArtifactRow(name, name, made.n_bytes, file_hash(place.here(path)))
