"""Exports that were asked for: wanted until the runner has made them, then artifacts like all others."""

from __future__ import annotations

import time
from dataclasses import asdict

import sqlalchemy as sa

from pipeline.exports.formats import FORMATS
from services.store.rows import DISMISSED, ArtifactRow, ExportRow
from services.store.store import Store
from services.store.tables import ARTIFACTS, EXPORTS, JOBS
from storage.packed.packed import SUFFIX

FOLDER = "exports"


def packed_artifact(store: Store, job: str) -> ArtifactRow | None:
    """The packed file that a job made, if it made just one."""
    found = [a for a in store.artifacts(job) if a.name.endswith(SUFFIX) and "/" not in a.name]
    return found[0] if len(found) == 1 else None


def export_name(packed: ArtifactRow, format: str) -> str:
    """The name of the artifact that is `packed` in another format."""
    return f"{FOLDER}/{packed.name.removesuffix(SUFFIX)}{FORMATS[format].suffix}"


def want_export(store: Store, job: str, format: str) -> dict | None:
    """Ask for one. What became of it where it was asked for before and failed, and is forgotten: asking again tries
    again; else None."""
    mine = (EXPORTS.c.job == job) & (EXPORTS.c.format == format)
    with store.engine.begin() as connection:
        known = connection.execute(sa.select(EXPORTS).where(mine)).mappings().first()
        if known is None:
            try:
                with connection.begin_nested():
                    connection.execute(EXPORTS.insert().values(job=job, format=format, requested=time.time()))
            except sa.exc.IntegrityError:  # another request was faster
                return None
        elif known["problem"] is not None:
            connection.execute(EXPORTS.delete().where(mine))
            return known["problem"]
    return None


def wanted_exports(store: Store, limit: int) -> list[ExportRow]:
    """The oldest that are neither made nor failed."""
    query = sa.select(EXPORTS).where(EXPORTS.c.problem.is_(sa.null())).order_by(EXPORTS.c.requested).limit(limit)
    return store._all(ExportRow, query)


def keep_export(store: Store, job: str, format: str, artifact: ArtifactRow) -> bool:
    """One that is made, as an artifact of its job; not where the job was dismissed or is gone."""
    with store.engine.begin() as connection:
        connection.execute(EXPORTS.delete().where(EXPORTS.c.job == job, EXPORTS.c.format == format))
        status = connection.scalar(sa.select(JOBS.c.status).where(JOBS.c.id == job))
        if status in (None, DISMISSED):
            return False
        connection.execute(ARTIFACTS.delete().where(ARTIFACTS.c.job == job, ARTIFACTS.c.name == artifact.name))
        connection.execute(ARTIFACTS.insert().values(job=job, **asdict(artifact)))
        return True


def fail_export(store: Store, job: str, format: str, problem: dict) -> None:
    """One that could not be made; whoever asks next is told why."""
    mine = (EXPORTS.c.job == job) & (EXPORTS.c.format == format)
    with store.engine.begin() as connection:
        connection.execute(EXPORTS.update().where(mine).values(problem=problem))
