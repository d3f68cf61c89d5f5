"""What a job does with its scan has columns of its own; it stood among the settings, under `process`."""

import sqlalchemy as sa
from alembic import op

revision = "3"
down_revision = "2"


def upgrade() -> None:
    """Jobs without a process among their settings compress."""
    op.add_column("jobs", sa.Column("process", sa.String(40), nullable=False, server_default="compress"))
    op.add_column("jobs", sa.Column("knobs", sa.JSON))
    op.add_column("jobs", sa.Column("budget_s", sa.Float))
    columns = [sa.column("settings", sa.JSON), sa.column("knobs", sa.JSON)]
    jobs = sa.table("jobs", *map(sa.column, ("id", "process", "budget_s")), *columns)
    connection = op.get_bind()
    for id, settings in connection.execute(sa.select(jobs.c.id, jobs.c.settings)).all():
        if (process := settings.pop("process", None)) is not None:
            moved = {"process": process["name"], "knobs": process["knobs"], "budget_s": process["budget_s"]}
            connection.execute(jobs.update().where(jobs.c.id == id).values(settings=settings, **moved))
