"""Taking in scans: an uploaded file is validated, named by its hash, and put in place; or it leaves nothing behind.

In the data folder:

    scans/<sha256>/scan.<suffix>    whatever its owners call it
    work/<sha256>/<stage>-<hash>/   the stages' outputs, shared by the jobs on a scan
    incoming/<random>/              an upload until it is accepted
"""

from __future__ import annotations

import hashlib
import re
import secrets
import time
from contextlib import AbstractContextManager
from pathlib import Path

from services.problems import Problem
from services.settings import ServiceSettings
from services.store.rows import ScanRow
from services.store.store import Store
from services.uploads.validation import validated_header
from services.uploads.volumes import taken_suffix
from storage import place

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
    """A new folder for what arrives and is not yet a scan."""
    folder = settings.data / "incoming" / secrets.token_hex(16)
    folder.mkdir(parents=True)
    return folder


def disk_name(file: str) -> str:
    """The same for whoever brings it, but for what the readers go by."""
    return "scan" + taken_suffix(file)


def scan_path(settings: ServiceSettings, scan: ScanRow) -> Path:
    """Where a scan lies."""
    return settings.place / "scans" / scan.id / scan.path_name


def work_folder(settings: ServiceSettings, scan_id: str) -> Path:
    """Where the stages of a scan's jobs leave their outputs."""
    return settings.place / "work" / scan_id


def accept_scan(path: Path, owner: str, settings: ServiceSettings, store: Store) -> tuple[ScanRow, bool]:
    """Make a scan of the uploaded file at `path`, which may be moved; returns it, and whether it is new to its
    owner.

    Raises: Problem; `path` is left where it was.
    """
    if path.stat().st_size == 0:
        raise Problem(422, "bad-scan", f"{path.name}: an empty file, 0 bytes; allowed: a scan")
    id = file_hash(path)
    known = store.scan(id, owner)
    header = known.header if known else validated_header(path, settings)  # read anew for a new owner, whoever has it
    scan = ScanRow(id, path.name, disk_name(path.name), path.stat().st_size, header, time.time())
    with scans_alone(settings):
        target = scan_path(settings, store.scan(id) or scan)
        if not place.is_file(target):
            place.put_in_place(path, target)
        new = store.add_scan(scan, owner)
    return store.scan(id, owner), new


def scans_alone(settings: ServiceSettings) -> AbstractContextManager[None]:
    """Putting a scan in place and taking it away again happen one after the other, in whichever process."""
    return place.alone(settings.place / "scans.lock", poll_s=0.02)


def file_hash(path: Path) -> str:
    """The SHA-256 of a file, as hexadecimal digits."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def discard_unused_scans(settings: ServiceSettings, store: Store) -> None:
    """The row goes first: files without a row are harmless, a row without is not."""
    for scan in store.unused_scans():
        with scans_alone(settings):
            if store.forget_scan(scan.id):
                _discard(settings, scan.id)


def _discard(settings: ServiceSettings, id: str) -> None:
    place.remove_folder(settings.place / "scans" / id)
    place.remove_folder(work_folder(settings, id))
