"""Room on the disk of the data folder: asked for before a stage, and kept back for the word that there is none left.

A full disk fails the stage that filled it. Where the databases lie on the same disk the job's end could then not be
written either, so a file of some size stands by: the runner gives it up first.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from services.settings import ServiceSettings
from storage import place
from storage.errors import ResourceExhausted

DATA_VERSION = 1  # of what lies where in a data folder; raised when an older program would not find its way
BALLAST_BYTES = 8 << 20  # the end of a job takes a few pages of two SQLite databases and their logs
HINT = "free some, then retry: what is done stays done"


def make_data_folder(settings: ServiceSettings) -> None:
    """Scans and results are their owners' alone: nobody else on this machine may look into a folder made here."""
    data = settings.data
    data.parent.mkdir(parents=True, exist_ok=True)
    data.mkdir(mode=0o700, exist_ok=True)
    _check_version(settings.place)
    (data / "incoming").mkdir(exist_ok=True)


def _check_version(data: Path) -> None:
    """A folder without the file is of version 1. Raises ResourceExhausted for one that a newer program has changed."""
    path = data / "version"
    try:
        found = place.read_text(path).strip()
    except FileNotFoundError:
        found = str(DATA_VERSION)
    if not found.isdigit() or int(found) > DATA_VERSION:
        hint = "use the splatpress that made it, or a newer one"
        raise ResourceExhausted(f"{path}", f"a data folder of version {found[:20]!r}", f"up to {DATA_VERSION}", hint)
    place.write_text(path, f"{DATA_VERSION}\n")


def check_room(settings: ServiceSettings, stage: str) -> None:
    """Raises ResourceExhausted where less than the reserve is free."""
    free, wanted = shutil.disk_usage(settings.data).free, settings.reserve_bytes
    if free < wanted:
        raise ResourceExhausted(
            f"stage {stage}", f"{free:,} bytes free on the disk of the data folder", f"at least {wanted:,}", HINT
        )


def take_ballast(data: Path) -> None:
    """Have the ballast on disk; where there is no room for it, none."""
    path = data / "ballast"
    if path.exists() and path.stat().st_size == BALLAST_BYTES:
        return
    try:
        with open(path, "wb") as stream:
            os.posix_fallocate(stream.fileno(), 0, BALLAST_BYTES)
    except OSError:
        drop_ballast(data)


def drop_ballast(data: Path) -> None:
    """Free what was set aside for a full disk."""
    (data / "ballast").unlink(missing_ok=True)
