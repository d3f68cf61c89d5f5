"""The tables of the service's database, SQLite or PostgreSQL.

A change here needs a revision in services/store/migrations/versions, which brings older databases to it; a test holds
the two against each other.
"""

from __future__ import annotations

from pathlib import Path

import sqlalchemy as sa

from services.store.migrate import migrate

METADATA = sa.MetaData()

TOKENS = sa.Table(
    "tokens",
    METADATA,
    sa.Column("hash", sa.String(64), primary_key=True),  # SHA-256 of the token; tokens hold 256 random bits
    sa.Column("owner", sa.String(100), nullable=False),
    sa.Column("created", sa.Float, nullable=False),
    sa.Column("label", sa.String(100), nullable=False, server_default=""),  # the owner's word for it
    sa.Column("expires", sa.Float),  # None: never
    sa.Column("used", sa.Float),  # when last, to the minute
)
SCANS = sa.Table(
    "scans",
    METADATA,
    sa.Column("id", sa.String(64), primary_key=True),  # SHA-256 of the uploaded bytes
    sa.Column("file", sa.String(200), nullable=False),  # its name on disk, in the scan's folder: no owner is told it
    sa.Column("bytes", sa.BigInteger, nullable=False),
    sa.Column("header", sa.JSON, nullable=False),
    sa.Column("created", sa.Float, nullable=False),
)
SCAN_OWNERS = sa.Table(
    "scan_owners",
    METADATA,
    sa.Column("scan", sa.ForeignKey("scans.id", ondelete="CASCADE"), primary_key=True),
    sa.Column("owner", sa.String(100), primary_key=True),
    sa.Column("file", sa.String(200), nullable=False, server_default=""),  # the owner's name for it
    sa.Column("header", sa.JSON, nullable=False, server_default="{}"),  # as read from the owner's upload
    sa.Column("created", sa.Float, nullable=False, server_default="0"),
)
JOBS = sa.Table(
    "jobs",
    METADATA,
    sa.Column("id", sa.String(32), primary_key=True),
    sa.Column("owner", sa.String(100), nullable=False, index=True),
    sa.Column("scan", sa.String(64), nullable=False, index=True),
    sa.Column("name", sa.String(200), nullable=False),
    sa.Column("settings", sa.JSON, nullable=False),
    sa.Column("process", sa.String(40), nullable=False, server_default="compress"),
    sa.Column("knobs", sa.JSON),  # of a trade-off: the values to measure by knob; None leaves them to it
    sa.Column("budget_s", sa.Float),  # of a trade-off
    sa.Column("webhook", sa.String(2000)),
    sa.Column("webhook_due", sa.Float),  # None: nothing to deliver
    sa.Column("webhook_tries", sa.Integer, nullable=False, default=0),
    sa.Column("status", sa.String(12), nullable=False, index=True),
    sa.Column("attempt", sa.Integer, nullable=False),  # a runner of an older attempt may commit nothing
    sa.Column("progress", sa.Integer, nullable=False),
    sa.Column("stage", sa.String(40)),
    sa.Column("message", sa.String(2000)),
    sa.Column("problem", sa.JSON),
    sa.Column("live", sa.JSON),  # splats a second, seconds left, current PSNR
    sa.Column("created", sa.Float, nullable=False),
    sa.Column("started", sa.Float),
    sa.Column("finished", sa.Float),
    sa.Column("updated", sa.Float, nullable=False),
    sa.Column("pinned", sa.Boolean, nullable=False, default=False),
    sa.Column("request_key", sa.String(255)),
    sa.Column("request_hash", sa.String(64)),
    sa.UniqueConstraint("owner", "request_key"),
)
EVENTS = sa.Table(
    "events",
    METADATA,
    sa.Column("id", sa.Integer, primary_key=True, autoincrement=True),
    sa.Column("job", sa.ForeignKey("jobs.id", ondelete="CASCADE"), nullable=False),
    sa.Column("time", sa.Float, nullable=False),
    sa.Column("kind", sa.String(12), nullable=False),  # status | progress | learning | log
    sa.Column("level", sa.String(8)),  # of a log line
    sa.Column("data", sa.JSON, nullable=False),
    sa.Index("events_of_a_job", "job", "id"),
    sqlite_autoincrement=True,
)
ARTIFACTS = sa.Table(
    "artifacts",
    METADATA,
    sa.Column("job", sa.ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True),
    sa.Column("name", sa.String(300), primary_key=True),
    sa.Column("path", sa.String(1000), nullable=False),  # below the job's folder
    sa.Column("bytes", sa.BigInteger, nullable=False),
    sa.Column("sha256", sa.String(64), nullable=False),
)
EXPORTS = sa.Table(
    "exports",
    METADATA,
    sa.Column("job", sa.ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True),
    sa.Column("format", sa.String(20), primary_key=True),
    sa.Column("requested", sa.Float, nullable=False),
    sa.Column("problem", sa.JSON(none_as_null=True)),  # why it could not be made; None: it is wanted
)
UPLOADS = sa.Table(
    "uploads",
    METADATA,
    sa.Column("id", sa.String(32), primary_key=True),
    sa.Column("owner", sa.String(100), nullable=False),
    sa.Column("file", sa.String(200), nullable=False),
    sa.Column("length", sa.BigInteger, nullable=False),  # -1: said later
    sa.Column("metadata", sa.String(4000), nullable=False),
    sa.Column("expires", sa.Float, nullable=False),
    sa.Column("scan", sa.String(64)),  # set once it is whole and accepted
    sa.Column("problem", sa.JSON),  # why it was refused
    sa.Column("concat", sa.String(4000), nullable=False, server_default=""),  # tus: a part, or made of parts
)
AUDIT = sa.Table(
    "audit",
    METADATA,
    sa.Column("id", sa.Integer, primary_key=True, autoincrement=True),
    sa.Column("time", sa.Float, nullable=False),
    sa.Column("owner", sa.String(100), nullable=False),
    sa.Column("action", sa.String(40), nullable=False),
    sa.Column("target", sa.String(100), nullable=False),
    sa.Column("client", sa.String(100), nullable=False),  # the address that asked
    sa.Index("audit_by_owner", "owner", "id"),
    sqlite_autoincrement=True,
)
STAGE_TOTALS = sa.Table(
    "stage_totals",
    METADATA,
    sa.Column("stage", sa.String(40), primary_key=True),
    sa.Column("seconds", sa.Float, nullable=False),
    sa.Column("runs", sa.BigInteger, nullable=False),
    sa.Column("splats", sa.BigInteger, nullable=False),
)


def engine_for(url: str) -> sa.Engine:
    """An engine whose tables are those of here."""
    sqlite = url.startswith("sqlite")
    if sqlite:
        Path(sa.make_url(url).database).parent.mkdir(parents=True, exist_ok=True)
        engine = sa.create_engine(url, connect_args={"timeout": 30})
        sa.event.listen(engine, "connect", _prepare_sqlite)
    else:
        engine = sa.create_engine(_with_driver(url), pool_pre_ping=True)
    migrate(engine)
    return engine


def _with_driver(url: str) -> sa.URL:
    parsed = sa.make_url(url)
    return parsed.set(drivername="postgresql+psycopg") if parsed.drivername in ("postgres", "postgresql") else parsed


def _prepare_sqlite(connection, _) -> None:
    for pragma in ("journal_mode=WAL", "synchronous=NORMAL", "foreign_keys=ON", "busy_timeout=30000"):
        connection.execute(f"PRAGMA {pragma}")
