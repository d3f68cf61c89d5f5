"""A service's scans, jobs, results and tokens as one file, taken while it runs, and a data folder made of one.

The file is a tar: `backup.json`, `database.sqlite` with all rows as they were at one moment, then the files that those
rows name. Outputs of stages are not in it; a job that was under way makes them again, with the same bytes.
"""

from __future__ import annotations

import json
import os
import secrets
import tarfile
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from services.jobs.disk import make_data_folder
from services.jobs.workflow import job_folder
from services.settings import ServiceSettings
from services.store.copy import copy_rows
from services.store.migrate import newest
from services.store.store import Store
from services.uploads.scans import scan_path
from storage import place
from storage.errors import InvalidPackedFile, ResourceExhausted

FORMAT = 1
ABOUT, DATABASE, KEY = "backup.json", "database.sqlite", "webhook-key"


@dataclass(frozen=True)
class Backup:
    """What is in one: rows a table, files and their bytes, and files that rows name but that were not there."""

    format: int
    revision: str
    made: float
    rows: dict[str, int]
    n_files: int
    n_bytes: int
    missing: tuple[str, ...]


def back_up(settings: ServiceSettings, path: Path) -> Backup:
    """Written whole or not at all. Raises OSError where it cannot be."""
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
    store = Store(settings.database_url)
    try:
        with tempfile.TemporaryDirectory(dir=settings.data) as folder:
            copy = Store(f"sqlite:///{Path(folder) / DATABASE}")
            rows = copy_rows(store, copy)
            files = list(_files(settings, copy))
            copy.close()
            made = _write(partial, Path(folder) / DATABASE, rows, files, settings.place)
        os.replace(partial, path)
        return made
    finally:
        store.close()
        partial.unlink(missing_ok=True)


def _files(settings: ServiceSettings, rows: Store) -> Iterator[Path]:
    yield settings.place / KEY
    for scan in rows.all_scans():
        yield scan_path(settings, scan)
    for job, path in rows.all_artifact_paths():
        yield job_folder(settings, job) / path


def _write(partial: Path, database: Path, rows: dict[str, int], files: list[Path], folder: Path) -> Backup:
    n_files = n_bytes = 0
    missing = []
    os.close(
        os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    )  # the owners' scans, and the hashes of tokens
    with tarfile.open(partial, "w", format=tarfile.PAX_FORMAT) as tar:
        tar.add(database, DATABASE)
        for file in dict.fromkeys(files):
            name = file.relative_to(folder).as_posix()
            try:
                with open(place.here(file), "rb") as stream:
                    entry = tar.gettarinfo(arcname=name, fileobj=stream)
                    entry.uid = entry.gid = 0
                    entry.uname = entry.gname = ""
                    tar.addfile(entry, stream)
            except FileNotFoundError:
                if name != KEY:  # there is none before the first webhook
                    missing.append(name)
                continue
            n_files, n_bytes = n_files + 1, n_bytes + entry.size
        made = Backup(FORMAT, newest(), time.time(), rows, n_files, n_bytes, tuple(missing))
        about = json.dumps(asdict(made)).encode()
        entry = tarfile.TarInfo(ABOUT)
        entry.size, entry.mode = len(about), 0o600
        with tempfile.TemporaryFile() as stream:
            stream.write(about)
            stream.seek(0)
            tar.addfile(entry, stream)
    with open(partial, "rb") as stream:
        os.fsync(stream.fileno())
    return made


def restore(settings: ServiceSettings, path: Path) -> Backup:
    """Into a data folder and a database that are empty; jobs that were under way go on once a runner starts.

    Raises: InvalidPackedFile for a file that is no whole backup, ResourceExhausted for a folder that is not empty,
    NotEmpty for such a database.
    """
    for folder in (settings.data, settings.place):
        if place.names(folder):
            raise ResourceExhausted(str(folder), "a folder that is not empty", "an empty one, or none")
    make_data_folder(settings)
    try:
        with tarfile.open(path) as tar:
            tar.extractall(settings.data, filter="data")
        about = json.loads((settings.data / ABOUT).read_text())  # written last: without it the file was cut off
        found = Backup(**{**about, "missing": tuple(about["missing"])})
    except (tarfile.TarError, EOFError, FileNotFoundError, ValueError, TypeError, KeyError) as error:
        if not path.is_file():
            raise
        raise InvalidPackedFile(str(path), f"no whole backup ({error})", "what `splatpress backup` wrote") from error
    if found.format != FORMAT:
        raise InvalidPackedFile(str(path), f"a backup of format {found.format}", f"{FORMAT}")
    taken = settings.data / f"{DATABASE}.restored"
    os.replace(settings.data / DATABASE, taken)
    source, target = Store(f"sqlite:///{taken}"), Store(settings.database_url)
    try:
        copy_rows(source, target)
    finally:
        source.close()
        target.close()
        for left in settings.data.glob(f"{taken.name}*"):
            left.unlink()
    (settings.data / ABOUT).unlink()
    _put_where_it_belongs(settings)
    return found


def _put_where_it_belongs(settings: ServiceSettings) -> None:
    """What was unpacked here, where scans and results lie in a bucket."""
    if settings.place != settings.data:
        for folder in ("scans", "jobs"):
            place.put_folder(settings.data / folder, settings.place / folder)
            place.remove_folder(settings.data / folder)
        if (settings.data / KEY).exists():
            place.put_in_place(settings.data / KEY, settings.place / KEY)
