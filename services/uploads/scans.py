"""Taking in scans: an uploaded file is validated, named by its hash, and put in place; or it leaves nothing behind.

In the data folder:

    scans/<sha256>/<file name>
    work/<sha256>/<stage>-<hash>/   the stages' outputs, shared by the jobs on a scan
    incoming/<random>/              an upload until it is accepted
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import shutil
from pathlib import Path

from services.problems import Problem
from services.settings import ServiceSettings
from services.store.store import Store
from services.uploads.validation import validated_header

MAX_NAME = 120
BLOCK_BYTES = 1 << 20


def safe_name(name: str) -> str:
    """A plain file name that keeps its suffix.

    >>> safe_name("../../etc/pass wd?.ply"), safe_name("C:\\\\scans\\\\a.zip"), safe_name("..")
    ('pass wd_.ply', 'a.zip', 'scan')
    """
    plain = re.sub(r"[^\w .()+-]", "_", re.split(r"[/\\]", name)[-1]).strip(". ")
    stem, dot, suffix = plain.rpartition(".")
    return (f"{stem[: MAX_NAME - 10]}{dot}{suffix[:9]}" if dot else plain[:MAX_NAME]) or "scan"


def incoming_folder(settings: ServiceSettings) -> Path:
    folder = settings.data / "incoming" / secrets.token_hex(16)
    folder.mkdir(parents=True)
    return folder


def scan_path(settings: ServiceSettings, scan: dict) -> Path:
    return settings.data / "scans" / scan["id"] / scan["file"]


def work_folder(settings: ServiceSettings, scan_id: str) -> Path:
    return settings.data / "work" / scan_id


def accept_scan(path: Path, owner: str, settings: ServiceSettings, store: Store) -> tuple[dict, bool]:
    """Make a scan of the uploaded file at `path`, which is moved; returns it, and whether it is new to the service.

    Raises: Problem; `path` is left where it was.
    """
    if path.stat().st_size == 0:
        raise Problem(422, "bad-scan", f"{path.name}: an empty file, 0 bytes; allowed: a scan")
    id = file_hash(path)
    if (known := store.scan(id)) is None:
        header = validated_header(path, settings)
        known = {"id": id, "file": path.name, "bytes": path.stat().st_size, "header": header}
        _put_in_place(path, scan_path(settings, known))
    new = store.add_scan(known, owner)
    return store.scan(id), new


def file_hash(path: Path) -> str:
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _put_in_place(path: Path, target: Path) -> None:
    """Durably: the database says that the scan is there only once it is."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "rb") as stream:
        os.fsync(stream.fileno())
    os.replace(path, target)


def discard_scan(settings: ServiceSettings, id: str) -> None:
    shutil.rmtree(settings.data / "scans" / id, ignore_errors=True)
    shutil.rmtree(work_folder(settings, id), ignore_errors=True)
