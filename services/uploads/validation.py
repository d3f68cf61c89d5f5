"""Reads an untrusted scan's headers in a process of its own, which may run out of memory or time, or crash.

`python -m services.uploads.validation PATH` with the limits as JSON on stdin; prints {"header": ...} or {"problem":
...}.
"""

from __future__ import annotations

import errno
import json
import resource
import signal
import subprocess
import sys
import warnings
import zipfile
from pathlib import Path

import numpy as np

from services.problems import Problem, mistake
from services.settings import ServiceSettings
from services.uploads.volumes import VOLUMES, taken_suffix, volume_header

PIECE = 1 << 16
MAX_POINTS_READ = 1 << 20  # about a second


def validated_header(path: Path, settings: ServiceSettings) -> dict:
    """What `splatpress inspect` says of the scan at `path`, with every name relative to its folder.

    Raises: Problem 422 for a scan that breaks its format or a limit, 415 for a format that is not handled, 500 for a
    reader that crashed or could not read its file, which is our mistake.
    """
    slow = Problem(422, "bad-scan", f"{path.name}: headers that take longer than {settings.validation_s:g} s to read")
    limits = {
        name: getattr(settings, name)
        for name in (
            "max_unpacked_bytes",
            "max_archive_files",
            "max_archive_ratio",
            "max_photo_pixels",
            "validation_memory_bytes",
            "validation_s",
        )
    }
    try:
        child = subprocess.run(
            [sys.executable, "-m", "services.uploads.validation", str(path.absolute())],
            input=json.dumps(limits),
            capture_output=True,
            text=True,
            timeout=settings.validation_s,
            cwd=Path(__file__).resolve().parents[2],
        )
    except subprocess.TimeoutExpired:
        raise slow from None
    lines = child.stdout.splitlines()
    if child.returncode == -signal.SIGXCPU:
        raise slow
    if child.returncode != 0 or not lines:
        raise mistake(f"the reader of {path} ended with exit status {child.returncode}: {child.stderr[-4000:]}")
    answer = json.loads(lines[-1].replace(json.dumps(str(path.absolute().parent))[1:-1] + "/", ""))
    if "problem" in answer:
        raise Problem(**answer["problem"])
    return answer["header"]


def _main() -> None:
    path, limits = Path(sys.argv[1]), json.loads(sys.stdin.read())
    memory, seconds = int(limits["validation_memory_bytes"]), int(limits["validation_s"]) + 1
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    warnings.simplefilter("ignore")
    print(json.dumps(_answer(path, limits)))


def _answer(path: Path, limits: dict) -> dict:
    from pipeline.readers import inspect_scan
    from storage.errors import SplatpressError, UnsupportedScan

    path.open("rb").close()  # a file that is not there, or may not be read, is no fault of the scan's
    try:
        if path.suffix.lower() == ".zip":
            _check_archive(path, limits)
        if taken_suffix(path.name) in VOLUMES:
            return {"header": volume_header(path, limits)}
        header = inspect_scan(str(path))
        _check_photos(header, limits)
        _check_points(path, header)
        return {"header": header}
    except Problem as problem:
        return {"problem": _as_json(problem)}
    except SplatpressError as error:
        unsupported = isinstance(error, UnsupportedScan)
        slug = "unsupported-scan" if unsupported else "bad-scan"
        return {"problem": _as_json(Problem(415 if unsupported else 422, slug, str(error), hint=error.hint))}
    except MemoryError:
        return {"problem": _as_json(Problem(422, "bad-scan", f"{path.name}: headers that need too much memory"))}


def _as_json(problem: Problem) -> dict:
    return {"status": problem.status, "slug": problem.slug, "detail": problem.detail, "hint": problem.hint}


def _check_archive(path: Path, limits: dict) -> None:
    """The limits of this service; names, links and overlaps are the reader's to check."""
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
    except (zipfile.BadZipFile, EOFError, OSError, ValueError) as error:
        if (
            isinstance(error, OSError) and error.errno != errno.EINVAL
        ):  # which a place before the file's beginning gives
            raise
        raise Problem(422, "bad-scan", f"{path.name}: not a whole .zip; allowed: a .zip archive") from error
    unpacked, packed = sum(e.file_size for e in entries), max(1, path.stat().st_size)
    for found, allowed, what in (
        (len(entries), limits["max_archive_files"], "members"),
        (unpacked, limits["max_unpacked_bytes"], "bytes unpacked"),
        (unpacked / packed, limits["max_archive_ratio"], "bytes unpacked for one packed"),
    ):
        if found > allowed:
            raise Problem(
                422, "archive-too-large", f"{path.name}: {found:,.0f} {what}; allowed: at most {allowed:,.0f}"
            )


def _check_points(path: Path, header: dict) -> None:
    """Look at the first points too: a scan without one finite position would fail hours later."""
    from pipeline.readers import open_scan

    n_read = n_bad = 0
    for piece in open_scan(str(path)).pieces(PIECE):
        n_read += len(piece.position)
        n_bad += int((~np.isfinite(piece.position).all(axis=1)).sum())
        if n_read >= MAX_POINTS_READ:
            break
    if n_bad == n_read:
        raise Problem(
            422,
            "bad-scan",
            f"{path.name}: none of its first {n_read:,} points has a finite position; allowed: at least one",
        )
    if n_bad:
        header["warnings"].append(
            f"{n_bad:,} of the first {n_read:,} points have a position that is not finite and will be dropped"
        )


def _check_photos(header: dict, limits: dict) -> None:
    allowed = limits["max_photo_pixels"]
    for size in header["cameras"]["sizes"]:
        width, height = (int(side) for side in size.split("x"))
        if width * height > allowed:
            raise Problem(
                422, "photo-too-large", f"{header['path']}: a photo of {size} pixels; allowed: {allowed:,} pixels"
            )


if __name__ == "__main__":
    _main()
