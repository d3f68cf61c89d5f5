"""The database's schema brought up to date, by Alembic's revisions (services/store/migrations/versions)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import sqlalchemy as sa
from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory

from storage.errors import SplatpressError
from storage.file_lock import hold

FIRST = "1"
_LOCK_KEY = 0x73706C6174  # of PostgreSQL's advisory lock
_FOLDER = Path(__file__).parent / "migrations"


class NewerDatabase(SplatpressError):
    """A database that a newer version of the program has changed."""

    kind = "resource"
    exit_code = 2


def migrate(engine: sa.Engine) -> None:
    """Bring the schema to the newest revision; one process at a time does it, others wait and find it done.

    Raises: NewerDatabase naming the revision that is not known here.
    """
    with _alone(engine) as connection:
        config = _config(connection)
        known = {script.revision for script in ScriptDirectory.from_config(config).walk_revisions()}
        found = MigrationContext.configure(connection).get_current_revision()
        if found is not None and found not in known:
            raise NewerDatabase("the database", f"revision {found}", f"up to {newest()}", "use a newer splatpress")
        if found is None and sa.inspect(connection).has_table("jobs"):
            command.stamp(config, FIRST)
        if found != newest():
            command.upgrade(config, "head")
        connection.commit()


def newest() -> str:
    """The latest revision of the schema."""
    return ScriptDirectory(str(_FOLDER)).get_current_head()


def _config(connection: sa.Connection) -> Config:
    config = Config(attributes={"connection": connection})
    config.set_main_option("script_location", str(_FOLDER).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    return config


@contextmanager
def _alone(engine: sa.Engine) -> Iterator[sa.Connection]:
    """A connection, while no other process has one from here."""
    database = engine.url.database if engine.dialect.name == "sqlite" else None
    if database is None:
        with engine.connect() as connection:
            connection.execute(sa.text(f"SELECT pg_advisory_lock({_LOCK_KEY})"))
            try:
                yield connection
            finally:
                connection.rollback()
                connection.execute(sa.text(f"SELECT pg_advisory_unlock({_LOCK_KEY})"))
                connection.commit()
        return
    with open(f"{database}.migrating", "w") as lock:
        hold(lock)
        with engine.connect() as connection:
            yield connection
