"""Estimates beside the stages they were made from, and set against what then happened."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path

from pipeline.planning.settings import Settings
from storage import place
from storage.work import work

FOLDER = "estimates"
FIGURES = ("seconds", "peak_memory_bytes", "gpu_bytes", "file_bytes", "texture_psnr_db", "pages_bytes")


def keep_estimate(work_folder: Path, settings: Settings, estimate: dict) -> None:
    """Keep an estimate in the work folder that it was made in, under its settings."""
    path = _path(work_folder, settings)
    place.make_folder(path.parent)
    work.write_json(path, estimate)


def known_estimate(work_folder: Path, settings: Settings) -> dict | None:
    """The estimate that was made in a work folder for these settings."""
    path = _path(work_folder, settings)
    return work.read_json(path) if place.is_file(path) else None


def _path(work_folder: Path, settings: Settings) -> Path:
    text = json.dumps(asdict(settings), sort_keys=True)
    return work_folder / FOLDER / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.json"


def against(estimate: dict | None, happened: dict[str, float | None]) -> dict | None:
    """By figure: value, low and high of the estimate, and what happened; None without an estimate."""
    if estimate is None:
        return None
    return {
        name: estimate[name] | {"happened": happened[name]}
        for name in FIGURES
        if estimate.get(name) and happened.get(name) is not None
    }
