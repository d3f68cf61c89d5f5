"""What an owner is told of a scan stands with the owner, not with the content that two owners may share; tokens that
expire and say when they were used; uploads that are part of another; a record of who did what; exports."""

import sqlalchemy as sa
from alembic import op

revision = "2"
down_revision = "1"


def upgrade() -> None:
    """Scans are known to each owner under that owner's name for them."""
    op.add_column("scan_owners", sa.Column("file", sa.String(200), nullable=False, server_default=""))
    op.add_column("scan_owners", sa.Column("header", sa.JSON, nullable=False, server_default="{}"))
    op.add_column("scan_owners", sa.Column("created", sa.Float, nullable=False, server_default="0"))
    scans, owned = (
        sa.table(name, *map(sa.column, names))
        for name, names in (
            ("scans", ("id", "file", "header", "created")),
            ("scan_owners", ("scan", "file", "header", "created")),
        )
    )
    for name in ("file", "header", "created"):
        of_scan = sa.select(scans.c[name]).where(scans.c.id == owned.c.scan).scalar_subquery()
        op.execute(owned.update().values({name: of_scan}))
    op.add_column("tokens", sa.Column("label", sa.String(100), nullable=False, server_default=""))
    op.add_column("tokens", sa.Column("expires", sa.Float))
    op.add_column("tokens", sa.Column("used", sa.Float))
    op.add_column("uploads", sa.Column("concat", sa.String(4000), nullable=False, server_default=""))
    op.create_table(
        "audit",
        sa.Column("id", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("time", sa.Float, nullable=False),
        sa.Column("owner", sa.String(100), nullable=False),
        sa.Column("action", sa.String(40), nullable=False),
        sa.Column("target", sa.String(100), nullable=False),
        sa.Column("client", sa.String(100), nullable=False),
        sqlite_autoincrement=True,
    )
    op.create_index("audit_by_owner", "audit", ["owner", "id"])
    if not sa.inspect(op.get_bind()).has_table("exports"):  # some databases had it before they had revisions
        op.create_table(
            "exports",
            sa.Column("job", sa.String(32), sa.ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True),
            sa.Column("format", sa.String(20), primary_key=True),
            sa.Column("requested", sa.Float, nullable=False),
            sa.Column("problem", sa.JSON),
        )
