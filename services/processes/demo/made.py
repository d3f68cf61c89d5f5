"""What a demo has made before, known again: the second run of `make demo` has nothing to compute."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path

from pipeline.planning.settings import Settings
from renderer.report.report import REPORT_NAME
from storage.errors import SplatpressError
from storage.packed.packed import SUFFIX, PackedFile

MARK = ".made-by"
ROOT = Path(__file__).resolve().parents[3]
PACKAGES = ("storage", "pipeline", "renderer", "services")


def known(out: Path, settings: Settings, scan: str, draws: bool) -> dict | None:
    """The report of what lies in `out`, where this very program made it with these settings and all of it is whole."""
    try:
        if (out / MARK).read_text() != _made_by(settings, scan, draws):
            return None
        with PackedFile(next(out.glob(f"*{SUFFIX}"))):  # checks its seal
            return json.loads((out / REPORT_NAME).read_text())
    except (OSError, ValueError, StopIteration, SplatpressError):
        return None


def remember(out: Path, settings: Settings, scan: str, draws: bool) -> None:
    """Say in `out` what made it."""
    (out / MARK).write_text(_made_by(settings, scan, draws))


def _made_by(settings: Settings, scan: str, draws: bool) -> str:
    """A hash of the settings and of the text of all files of the program."""
    state = hashlib.sha256(json.dumps([asdict(settings), scan, draws]).encode())
    for path in sorted(path for name in PACKAGES for path in (ROOT / name).rglob("*")):
        if path.is_file() and path.suffix != ".pyc":
            state.update(path.read_bytes())
    return state.hexdigest()
