"""Signs of life that the runner leaves in the data folder, for the API to read."""

from __future__ import annotations

import time
from pathlib import Path

_ALIVE, _DASHBOARD = "runner.alive", "dashboard.txt"


def show_alive(data: Path) -> None:
    (data / _ALIVE).touch()


def show_gone(data: Path) -> None:
    (data / _ALIVE).unlink(missing_ok=True)


def runner_age_s(data: Path) -> float | None:
    """Seconds since the runner last showed itself."""
    try:
        return max(0.0, time.time() - (data / _ALIVE).stat().st_mtime)
    except FileNotFoundError:
        return None


def show_dashboard(data: Path, url: str) -> None:
    (data / _DASHBOARD).write_text(url)


def dashboard(data: Path) -> str:
    try:
        return (data / _DASHBOARD).read_text().strip()
    except FileNotFoundError:
        return ""
