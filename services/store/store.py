"""Jobs, scans, tokens and uploads: every change of their state is one statement or one transaction here."""

from __future__ import annotations

import functools
import secrets
import time
from dataclasses import asdict
from typing import TypeVar

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from services.problems import is_of_database
from services.store import tokens
from services.store.rows import (
    ACCEPTED,
    DISMISSED,
    FAILED,
    LEVELS,
    LIVE,
    RUNNING,
    STATES,
    SUCCESSFUL,
    ArtifactRow,
    EventRow,
    Figures,
    JobRow,
    NewJob,
    ScanRow,
    StageTotals,
    UploadRow,
)
from services.store.tables import ARTIFACTS, EVENTS, JOBS, SCAN_OWNERS, SCANS, STAGE_TOTALS, UPLOADS, engine_for

R = TypeVar("R")
RETRY_S = 0.5


class KeyReused(Exception):
    """An Idempotency-Key that came before with another request."""


class TooManyJobs(Exception):
    """The owner has as many jobs in flight as are allowed."""


def _patient(method):
    """Wait for a database that is away, up to the store's patience; then do all of it again.

    A commit whose answer was lost is made again: a log line may then stand there twice, a job's state changes once.
    """

    @functools.wraps(method)
    def again(self, *arguments, **named):
        deadline = None
        while True:
            try:
                return method(self, *arguments, **named)
            except sa.exc.DBAPIError as error:
                deadline = deadline or time.monotonic() + self.patience_s
                if not is_of_database(error) or is_of_database(error, full=True) or time.monotonic() >= deadline:
                    raise
                self.away_since = self.away_since or time.time()
                time.sleep(RETRY_S)

    return again


class Store:
    """Opens the database of a URL. Safe in threads; rows come as their types (`services.store.rows`).

    `patience_s` is how long each call waits for a database that is away: none in the API, which says so at once, long
    in the runner, whose jobs are to outlive its restart.
    """

    def __init__(self, url: str, patience_s: float = 0.0) -> None:
        self.patience_s = patience_s
        self.away_since: float | None = None  # when a call first waited for the database
        self.engine = self._opened(url)

    @_patient
    def _opened(self, url: str) -> sa.Engine:
        return engine_for(url)

    def close(self) -> None:
        self.engine.dispose()

    def note_absence(self) -> None:
        """Say in the log of the jobs under way that the database was away, once it is back."""
        since, self.away_since = self.away_since, None
        if since is not None:
            for job in self.running_jobs():
                self.log(job.id, "warning", f"the database was away, for up to {time.time() - since:.0f} s; going on")

    # --- tokens

    def add_token(self, owner: str) -> str:
        return tokens.add_token(self, owner)[0]

    def owner_of(self, token: str) -> str | None:
        return tokens.owner_of(self, token)

    # --- scans

    def add_scan(self, scan: ScanRow, owner: str) -> bool:
        """Whether the scan is new to its owner, who has it from here on either way; whoever else has it makes no
        difference. Its time starts anew."""
        content = {"id": scan.id, "bytes": scan.bytes, "header": scan.header, "created": scan.created}
        if not self._insert_new(SCANS, {**content, "file": scan.path_name}):
            self._write(SCANS.update().where(SCANS.c.id == scan.id).values(created=scan.created))
        known = {"file": scan.file, "header": scan.header, "created": scan.created}
        new = self._insert_new(SCAN_OWNERS, {"scan": scan.id, "owner": owner, **known})
        if not new:
            self._write(SCAN_OWNERS.update().where(_owned(scan.id, owner)).values(created=scan.created))
        return new

    def scan(self, id: str, owner: str | None = None) -> ScanRow | None:
        """As its owner knows it; without an owner, under its name on disk."""
        if owner is None:
            return self._one(ScanRow, _SCANS.where(SCANS.c.id == id))
        return self._one(ScanRow, _OWNED_SCANS.where(_owned(id, owner)))

    def scans(self, owner: str, limit: int, offset: int) -> tuple[list[ScanRow], int]:
        """One page, newest first, and how many there are in all."""
        mine = SCAN_OWNERS.c.owner == owner
        order = (SCAN_OWNERS.c.created.desc(), SCANS.c.id)
        rows = self._all(ScanRow, _OWNED_SCANS.where(mine).order_by(*order).limit(limit).offset(offset))
        return rows, self._value(sa.select(sa.func.count()).select_from(SCAN_OWNERS).where(mine))

    def disown_expired_scans(self, before: float) -> None:
        """Where the owner has no job on it."""
        used = sa.exists().where(JOBS.c.scan == SCAN_OWNERS.c.scan, JOBS.c.owner == SCAN_OWNERS.c.owner)
        self._write(SCAN_OWNERS.delete().where(SCAN_OWNERS.c.created < before, ~used))

    def disown_scan(self, id: str, owner: str) -> bool:
        """Unless a job of the owner's on it is under way."""
        live = sa.exists().where(JOBS.c.scan == id, JOBS.c.owner == owner, JOBS.c.status.in_(LIVE))
        return self._write(SCAN_OWNERS.delete().where(_owned(id, owner), ~live)) == 1

    def all_scans(self) -> list[ScanRow]:
        """Of all owners, under their names on disk."""
        return self._all(ScanRow, _SCANS)

    def unused_scans(self) -> list[ScanRow]:
        """That no owner has any more, and no job needs."""
        return self._all(ScanRow, _SCANS.where(*_UNUSED))

    def forget_scan(self, id: str) -> bool:
        """Unless an owner or a job has come to need it."""
        return self._write(SCANS.delete().where(SCANS.c.id == id, *_UNUSED)) == 1

    # --- jobs

    def add_job(self, job: NewJob, max_in_flight: int) -> tuple[JobRow, bool]:
        """The job and whether it is new: a request key that came before with the same request gives the first job.

        Raises: KeyReused, TooManyJobs.
        """
        if (known := self._known(job)) is not None:
            return known, False
        now = time.time()
        row = {
            **asdict(job),
            "id": secrets.token_hex(16),
            "status": ACCEPTED,
            "attempt": 1,
            "progress": 0,
            "created": now,
            "updated": now,
            "pinned": False,
            "webhook_tries": 0,
        }
        try:
            with self.engine.begin() as connection:
                self._count_in_flight(connection, job.owner, max_in_flight)
                connection.execute(JOBS.insert().values(row))
                connection.execute(_event(row["id"], "status", {"status": ACCEPTED, "attempt": 1}))
        except sa.exc.IntegrityError:  # the same request came at the same moment
            return self._known(job), False
        return self.job(row["id"]), True

    def _known(self, job: NewJob) -> JobRow | None:
        if not job.request_key:
            return None
        mine = (JOBS.c.owner == job.owner, JOBS.c.request_key == job.request_key)
        row = self._one(JobRow, sa.select(JOBS).where(*mine))
        if row and row.request_hash != job.request_hash:
            raise KeyReused
        return row

    def _count_in_flight(self, connection, owner: str, allowed: int) -> None:
        live = sa.select(sa.func.count()).select_from(JOBS).where(JOBS.c.owner == owner, JOBS.c.status.in_(LIVE))
        if connection.scalar(live) >= allowed:
            raise TooManyJobs

    def job(self, id: str, owner: str | None = None) -> JobRow | None:
        query = sa.select(JOBS).where(JOBS.c.id == id)
        return self._one(JobRow, query if owner is None else query.where(JOBS.c.owner == owner))

    def jobs(
        self, owner: str, limit: int, offset: int, status: str | None = None, scan: str | None = None, words: str = ""
    ) -> tuple[list[JobRow], int]:
        """One page, newest first, and how many there are in all."""
        wanted = [
            JOBS.c.owner == owner,
            *([JOBS.c.status == status] if status else []),
            *([JOBS.c.scan == scan] if scan else []),
            *(JOBS.c.name.icontains(word, autoescape=True) for word in words.split()),
        ]
        page = sa.select(JOBS).where(*wanted).order_by(JOBS.c.created.desc(), JOBS.c.id).limit(limit).offset(offset)
        rows = self._all(JobRow, page)
        return rows, self._value(sa.select(sa.func.count()).select_from(JOBS).where(*wanted))

    def waiting_jobs(self, limit: int) -> list[JobRow]:
        waiting = sa.select(JOBS).where(JOBS.c.status == ACCEPTED)
        return self._all(JobRow, waiting.order_by(JOBS.c.created, JOBS.c.id).limit(limit))

    def running_jobs(self) -> list[JobRow]:
        return self._all(JobRow, sa.select(JOBS).where(JOBS.c.status == RUNNING))

    @_patient
    def begin(self, id: str, attempt: int) -> bool:
        """Let an accepted job run. True also where this attempt is running already: its runner died and is back."""
        now = time.time()
        with self.engine.begin() as connection:
            mine = (JOBS.c.id == id) & (JOBS.c.attempt == attempt)
            begun = connection.execute(
                JOBS.update()
                .where(mine, JOBS.c.status == ACCEPTED)
                .values(status=RUNNING, started=sa.func.coalesce(JOBS.c.started, now), updated=now)
            ).rowcount
            if begun:
                connection.execute(_event(id, "status", {"status": RUNNING, "attempt": attempt}))
            return bool(begun) or connection.scalar(sa.select(JOBS.c.status).where(mine)) == RUNNING

    def is_wanted(self, id: str, attempt: int) -> bool:
        return self._value(sa.select(JOBS.c.status).where(JOBS.c.id == id, JOBS.c.attempt == attempt)) == RUNNING

    @_patient
    def end(
        self, id: str, attempt: int, status: str, artifacts: list[ArtifactRow], problem: dict | None = None
    ) -> bool:
        """Commit what an attempt came to, unless it was dismissed or tried again meanwhile."""
        now = time.time()
        with self.engine.begin() as connection:
            done = (
                connection.execute(
                    JOBS.update()
                    .where(
                        JOBS.c.id == id,
                        JOBS.c.attempt == attempt,
                        JOBS.c.status == RUNNING,
                    )
                    .values(
                        status=status,
                        finished=now,
                        updated=now,
                        problem=problem,
                        live=None,
                        progress=100 if status == SUCCESSFUL else JOBS.c.progress,
                        webhook_due=_due(now),
                    )
                ).rowcount
                == 1
            )
            if done:
                _replace_artifacts(connection, id, artifacts)
                connection.execute(_event(id, "status", {"status": status, "attempt": attempt, "problem": problem}))
            return done

    @_patient
    def keep_artifacts(self, id: str, attempt: int, artifacts: list[ArtifactRow]) -> None:
        """What a dismissed attempt left."""
        with self.engine.begin() as connection:
            if (
                connection.scalar(sa.select(JOBS.c.attempt).where(JOBS.c.id == id, JOBS.c.status == DISMISSED))
                == attempt
            ):
                _replace_artifacts(connection, id, artifacts)

    @_patient
    def dismiss(self, id: str) -> str | None:
        """What the job was until now; None where it was dismissed before. One that had ended loses its artifacts."""
        now = time.time()
        with self.engine.begin() as connection:
            for was in (*LIVE, SUCCESSFUL, FAILED):  # in the order that a job may move on while this looks
                if connection.execute(
                    JOBS.update()
                    .where(JOBS.c.id == id, JOBS.c.status == was)
                    .values(
                        status=DISMISSED,
                        finished=sa.func.coalesce(JOBS.c.finished, now),
                        updated=now,
                        live=None,
                        webhook_due=_due(now),
                    )
                ).rowcount:
                    connection.execute(_event(id, "status", {"status": DISMISSED}))
                    if was not in LIVE:
                        _replace_artifacts(connection, id, [])
                    return was
        return None

    def note_of_scan(self, id: str, owner: str, **found) -> None:
        """What a job of the owner's has learned of a scan, beside what its headers told."""
        scan = self.scan(id, owner)
        if scan is not None:
            self._write(SCAN_OWNERS.update().where(_owned(id, owner)).values(header=scan.header | found))

    @_patient
    def retry(self, id: str) -> bool:
        """Let a failed or dismissed job run again; its log and its creation date stay."""
        with self.engine.begin() as connection:
            done = (
                connection.execute(
                    JOBS.update()
                    .where(JOBS.c.id == id, JOBS.c.status.in_((FAILED, DISMISSED)))
                    .values(
                        status=ACCEPTED,
                        attempt=JOBS.c.attempt + 1,
                        progress=0,
                        stage=None,
                        finished=None,
                        problem=None,
                        message=None,
                        updated=time.time(),
                        webhook_due=None,
                        webhook_tries=0,
                    )
                ).rowcount
                == 1
            )
            if done:
                attempt = connection.scalar(sa.select(JOBS.c.attempt).where(JOBS.c.id == id))
                connection.execute(_event(id, "status", {"status": ACCEPTED, "attempt": attempt}))
            return done

    def change_job(self, id: str, **values) -> None:
        """What its owner may change at any time: pinned, name."""
        self._write(JOBS.update().where(JOBS.c.id == id).values(**values, updated=time.time()))

    def expired_jobs(self, before: float) -> list[JobRow]:
        ended = (JOBS.c.finished < before, JOBS.c.pinned.is_(False), JOBS.c.status.not_in(LIVE))
        return self._all(JobRow, sa.select(JOBS).where(*ended))

    def forget_job(self, id: str) -> bool:
        return (
            self._write(JOBS.delete().where(JOBS.c.id == id, JOBS.c.status.not_in(LIVE), JOBS.c.pinned.is_(False))) == 1
        )

    # --- webhooks

    def due_webhooks(self, limit: int, of_one_owner: int) -> list[JobRow]:
        """Those that are due for longest, at most so many of one owner."""
        due = (JOBS.c.webhook.is_not(None)) & (JOBS.c.webhook_due <= time.time())
        place = sa.func.row_number().over(partition_by=JOBS.c.owner, order_by=(JOBS.c.webhook_due, JOBS.c.id))
        ranked = sa.select(JOBS.c.id, place.label("place")).where(due).subquery()
        query = sa.select(JOBS).join(ranked, ranked.c.id == JOBS.c.id).where(ranked.c.place <= of_one_owner)
        return self._all(JobRow, query.order_by(JOBS.c.webhook_due, JOBS.c.id).limit(limit))

    def note_webhook(self, id: str, attempt: int, next_due: float | None) -> None:
        mine = (JOBS.c.id == id) & (JOBS.c.attempt == attempt)
        self._write(JOBS.update().where(mine).values(webhook_due=next_due, webhook_tries=JOBS.c.webhook_tries + 1))

    # --- events and progress

    @_patient
    def note_progress(self, id: str, attempt: int, progress: int, stage: str, live: dict) -> None:
        """One event, and the job's own fields; only of the attempt that runs."""
        with self.engine.begin() as connection:
            if connection.execute(
                JOBS.update()
                .where(
                    JOBS.c.id == id,
                    JOBS.c.attempt == attempt,
                    JOBS.c.status == RUNNING,
                )
                .values(progress=progress, stage=stage, live=live, updated=time.time())
            ).rowcount:
                connection.execute(_event(id, "progress", {"progress": progress, "stage": stage, **live}))

    def log(self, id: str, level: str, message: str) -> None:
        self._write(_event(id, "log", {"level": level, "message": message}, level))

    def note_learning(self, id: str, point: dict) -> None:
        self._write(_event(id, "learning", point))

    def events(self, job: str, after: int, limit: int = 500) -> list[EventRow]:
        later = sa.select(EVENTS).where(EVENTS.c.job == job, EVENTS.c.id > after)
        return self._all(EventRow, later.order_by(EVENTS.c.id).limit(limit))

    def logs(self, job: str, offset: int, limit: int, level: str = "debug") -> list[EventRow]:
        wanted = LEVELS[LEVELS.index(level) :]
        query = sa.select(EVENTS).where(EVENTS.c.job == job, EVENTS.c.kind == "log", EVENTS.c.level.in_(wanted))
        return self._all(EventRow, query.order_by(EVENTS.c.id).limit(limit).offset(offset))

    # --- artifacts

    def artifacts(self, job: str) -> list[ArtifactRow]:
        return self._all(ArtifactRow, _ARTIFACTS.where(ARTIFACTS.c.job == job).order_by(ARTIFACTS.c.name))

    def artifact(self, job: str, name: str) -> ArtifactRow | None:
        return self._one(ArtifactRow, _ARTIFACTS.where(ARTIFACTS.c.job == job, ARTIFACTS.c.name == name))

    def all_artifact_paths(self) -> list[tuple[str, str]]:
        """Job and path below the job's folder, of all artifacts there are."""
        query = sa.select(ARTIFACTS.c.job, ARTIFACTS.c.path).order_by(ARTIFACTS.c.job, ARTIFACTS.c.path)
        return [(job, path) for job, path in self._rows(query)]

    # --- uploads

    def add_upload(
        self, owner: str, file: str, length: int, metadata: str, expires: float, concat: str = ""
    ) -> UploadRow:
        row = UploadRow(secrets.token_hex(16), owner, file, length, metadata, expires, concat=concat)
        self._write(UPLOADS.insert().values(asdict(row)))
        return row

    def upload(self, id: str, owner: str | None = None) -> UploadRow | None:
        query = sa.select(UPLOADS).where(UPLOADS.c.id == id)
        return self._one(UploadRow, query if owner is None else query.where(UPLOADS.c.owner == owner))

    def open_uploads(self) -> list[UploadRow]:
        """Of all owners, newest last."""
        wanted = (UPLOADS.c.scan.is_(None), UPLOADS.c.expires >= time.time())
        return self._all(UploadRow, sa.select(UPLOADS).where(*wanted).order_by(UPLOADS.c.expires, UPLOADS.c.id))

    def bytes_of(self, owner: str) -> int:
        """Of the scans that an owner has."""
        mine = SCANS.c.id.in_(sa.select(SCAN_OWNERS.c.scan).where(SCAN_OWNERS.c.owner == owner))
        return int(self._value(sa.select(sa.func.coalesce(sa.func.sum(SCANS.c.bytes), 0)).where(mine)))

    def change_upload(self, id: str, **values) -> None:
        self._write(UPLOADS.update().where(UPLOADS.c.id == id).values(**values))

    def forget_upload(self, id: str) -> None:
        self._write(UPLOADS.delete().where(UPLOADS.c.id == id))

    def expired_uploads(self) -> list[UploadRow]:
        return self._all(UploadRow, sa.select(UPLOADS).where(UPLOADS.c.expires < time.time()))

    # --- figures

    def count_stage(self, stage: str, seconds: float, n_splats: int) -> None:
        totals = STAGE_TOTALS.c
        self._insert_new(STAGE_TOTALS, {"stage": stage, "seconds": 0.0, "runs": 0, "splats": 0})
        self._write(
            STAGE_TOTALS.update()
            .where(totals.stage == stage)
            .values(seconds=totals.seconds + seconds, runs=totals.runs + 1, splats=totals.splats + n_splats)
        )

    def figures(self) -> Figures:
        states = self._rows(sa.select(JOBS.c.status, sa.func.count()).group_by(JOBS.c.status))
        return Figures(
            jobs=dict.fromkeys(STATES, 0) | dict(tuple(row) for row in states),
            stages=self._all(StageTotals, sa.select(STAGE_TOTALS).order_by(STAGE_TOTALS.c.stage)),
            scan_bytes=int(self._value(sa.select(sa.func.coalesce(sa.func.sum(SCANS.c.bytes), 0)))),
            artifact_bytes=int(self._value(sa.select(sa.func.coalesce(sa.func.sum(ARTIFACTS.c.bytes), 0)))),
        )

    # --- helpers

    @_patient
    def _rows(self, query) -> list[sa.Row]:
        with self.engine.connect() as connection:
            return list(connection.execute(query).all())

    def _all(self, kind: type[R], query) -> list[R]:
        return [kind(**row._mapping) for row in self._rows(query)]

    def _one(self, kind: type[R], query) -> R | None:
        rows = self._all(kind, query.limit(1))
        return rows[0] if rows else None

    @_patient
    def _value(self, query):
        with self.engine.connect() as connection:
            return connection.scalar(query)

    @_patient
    def _write(self, statement) -> int:
        with self.engine.begin() as connection:
            return connection.execute(statement).rowcount

    def _insert_new(self, table: sa.Table, row: dict) -> bool:
        insert = {"sqlite": sqlite.insert, "postgresql": postgresql.insert}[self.engine.dialect.name]
        return self._write(insert(table).values(row).on_conflict_do_nothing()) == 1  # type: ignore[attr-defined]


_SCANS = sa.select(SCANS, SCANS.c.file.label("path_name"))
_ARTIFACTS = sa.select(ARTIFACTS.c.name, ARTIFACTS.c.path, ARTIFACTS.c.bytes, ARTIFACTS.c.sha256)
_OWNED_SCANS = sa.select(
    SCANS.c.id,
    SCANS.c.bytes,
    SCANS.c.file.label("path_name"),
    SCAN_OWNERS.c.file,
    SCAN_OWNERS.c.header,
    SCAN_OWNERS.c.created,
).join(SCAN_OWNERS, SCAN_OWNERS.c.scan == SCANS.c.id)
_UNUSED = (~sa.exists().where(JOBS.c.scan == SCANS.c.id), ~sa.exists().where(SCAN_OWNERS.c.scan == SCANS.c.id))


def _owned(scan: str, owner: str):
    return (SCAN_OWNERS.c.scan == scan) & (SCAN_OWNERS.c.owner == owner)


def _due(now: float):
    return sa.case((JOBS.c.webhook.is_not(None), now), else_=None)


def _event(job: str, kind: str, data: dict, level: str | None = None):
    return EVENTS.insert().values(job=job, time=time.time(), kind=kind, level=level, data=data)


def _replace_artifacts(connection, job: str, artifacts: list[ArtifactRow]) -> None:
    connection.execute(ARTIFACTS.delete().where(ARTIFACTS.c.job == job))
    if artifacts:
        connection.execute(ARTIFACTS.insert(), [{**asdict(a), "job": job} for a in artifacts])
