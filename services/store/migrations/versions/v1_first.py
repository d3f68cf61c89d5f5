"""The tables as they were before there were revisions: a database that has them and no revision is at this one."""

import sqlalchemy as sa
from alembic import op

revision = "1"
down_revision = None


def _job(**how) -> sa.Column:
    return sa.Column("job", sa.String(32), sa.ForeignKey("jobs.id", ondelete="CASCADE"), **how)


def upgrade() -> None:
    """The first tables."""
    op.create_table(
        "tokens",
        sa.Column("hash", sa.String(64), primary_key=True),
        sa.Column("owner", sa.String(100), nullable=False),
        sa.Column("created", sa.Float, nullable=False),
    )
    op.create_table(
        "scans",
        sa.Column("id", sa.String(64), primary_key=True),
        sa.Column("file", sa.String(200), nullable=False),
        sa.Column("bytes", sa.BigInteger, nullable=False),
        sa.Column("header", sa.JSON, nullable=False),
        sa.Column("created", sa.Float, nullable=False),
    )
    op.create_table(
        "scan_owners",
        sa.Column("scan", sa.String(64), sa.ForeignKey("scans.id", ondelete="CASCADE"), primary_key=True),
        sa.Column("owner", sa.String(100), primary_key=True),
    )
    op.create_table(
        "jobs",
        sa.Column("id", sa.String(32), primary_key=True),
        sa.Column("owner", sa.String(100), nullable=False, index=True),
        sa.Column("scan", sa.String(64), nullable=False, index=True),
        sa.Column("name", sa.String(200), nullable=False),
        sa.Column("settings", sa.JSON, nullable=False),
        sa.Column("webhook", sa.String(2000)),
        sa.Column("webhook_due", sa.Float),
        sa.Column("webhook_tries", sa.Integer, nullable=False),
        sa.Column("status", sa.String(12), nullable=False, index=True),
        sa.Column("attempt", sa.Integer, nullable=False),
        sa.Column("progress", sa.Integer, nullable=False),
        sa.Column("stage", sa.String(40)),
        sa.Column("message", sa.String(2000)),
        sa.Column("problem", sa.JSON),
        sa.Column("live", sa.JSON),
        sa.Column("created", sa.Float, nullable=False),
        sa.Column("started", sa.Float),
        sa.Column("finished", sa.Float),
        sa.Column("updated", sa.Float, nullable=False),
        sa.Column("pinned", sa.Boolean, nullable=False),
        sa.Column("request_key", sa.String(255)),
        sa.Column("request_hash", sa.String(64)),
        sa.UniqueConstraint("owner", "request_key"),
    )
    op.create_table(
        "events",
        sa.Column("id", sa.Integer, primary_key=True, autoincrement=True),
        _job(nullable=False),
        sa.Column("time", sa.Float, nullable=False),
        sa.Column("kind", sa.String(12), nullable=False),
        sa.Column("level", sa.String(8)),
        sa.Column("data", sa.JSON, nullable=False),
        sa.Index("events_of_a_job", "job", "id"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "artifacts",
        _job(primary_key=True),
        sa.Column("name", sa.String(300), primary_key=True),
        sa.Column("path", sa.String(1000), nullable=False),
        sa.Column("bytes", sa.BigInteger, nullable=False),
        sa.Column("sha256", sa.String(64), nullable=False),
    )
    op.create_table(
        "uploads",
        sa.Column("id", sa.String(32), primary_key=True),
        sa.Column("owner", sa.String(100), nullable=False),
        sa.Column("file", sa.String(200), nullable=False),
        sa.Column("length", sa.BigInteger, nullable=False),
        sa.Column("metadata", sa.String(4000), nullable=False),
        sa.Column("expires", sa.Float, nullable=False),
        sa.Column("scan", sa.String(64)),
        sa.Column("problem", sa.JSON),
    )
    op.create_table(
        "stage_totals",
        sa.Column("stage", sa.String(40), primary_key=True),
        sa.Column("seconds", sa.Float, nullable=False),
        sa.Column("runs", sa.BigInteger, nullable=False),
        sa.Column("splats", sa.BigInteger, nullable=False),
    )
