"""Signs of life that the runner leaves beside scans and results, for the API to read."""

from __future__ import annotations

import time
from pathlib import Path

from storage import place

_ALIVE, _DASHBOARD = "runner.alive", "dashboard.txt"
BUCKET_EVERY_S = 5.0  # a request each


class Heartbeat:
    """The runner's: `show` is called all the time."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._shown = folder, float("-inf")

    def show(self) -> None:
        if place.is_remote(self._folder) and time.monotonic() - self._shown < BUCKET_EVERY_S:
            return
        self._shown = time.monotonic()
        place.touch(self._folder / _ALIVE)


def show_gone(folder: Path) -> None:
    """Say that the runner has ended."""
    place.remove(folder / _ALIVE)


def runner_age_s(folder: Path) -> float | None:
    """Seconds since the runner last showed itself."""
    return place.age_s(folder / _ALIVE)


def show_dashboard(folder: Path, url: str) -> None:
    """Note the address of Dask's dashboard."""
    place.write_text(folder / _DASHBOARD, url)


def dashboard(folder: Path) -> str:
    """The address of Dask's dashboard; "" where there is none."""
    try:
        return place.read_text(folder / _DASHBOARD).strip()
    except FileNotFoundError:
        return ""
