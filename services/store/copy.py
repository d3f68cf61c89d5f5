"""All rows of one database into another, whichever of SQLite and PostgreSQL they are: for backups."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import sqlalchemy as sa

from services.store.store import Store
from services.store.tables import METADATA, UPLOADS
from storage.errors import SplatpressError

ROWS_AT_ONCE = 500


class NotEmpty(SplatpressError):
    """A database that has rows already."""

    kind = "data"
    exit_code = 2


def copy_rows(source: Store, target: Store) -> dict[str, int]:
    """Rows a table, as they were at one moment, though others write meanwhile. Uploads that are not whole stay behind.

    Raises: NotEmpty for a target that has rows.
    """
    with _snapshot(source.engine) as reading, target.engine.begin() as writing:
        for table in METADATA.sorted_tables:
            if (n := writing.scalar(sa.select(sa.func.count()).select_from(table))) != 0:
                raise NotEmpty("the database to restore into", f"{n} rows in {table.name}", "none")
        return {table.name: _copy(table, reading, writing) for table in METADATA.sorted_tables}


def _copy(table: sa.Table, reading: sa.Connection, writing: sa.Connection) -> int:
    query = sa.select(table) if table is not UPLOADS else sa.select(table).where(table.c.scan.is_not(None))
    n_rows = 0
    for rows in reading.execute(query).mappings().partitions(ROWS_AT_ONCE):
        writing.execute(table.insert(), [dict(row) for row in rows])
        n_rows += len(rows)
    numbered = table.autoincrement_column
    if n_rows and numbered is not None and numbered.autoincrement is True and writing.dialect.name == "postgresql":
        last = sa.select(sa.func.max(numbered)).scalar_subquery()
        writing.execute(sa.select(sa.func.setval(sa.func.pg_get_serial_sequence(table.name, numbered.name), last)))
    return n_rows


@contextmanager
def _snapshot(engine: sa.Engine) -> Iterator[sa.Connection]:
    with engine.connect() as connection:
        if engine.dialect.name == "sqlite":
            connection.exec_driver_sql("BEGIN")  # reads alone begin no transaction there
        else:
            connection = connection.execution_options(isolation_level="REPEATABLE READ")
        try:
            yield connection
        finally:
            connection.rollback()
