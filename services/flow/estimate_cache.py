"""Estimates beside the stages they were made from, and set against what then happened."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path

import msgspec

from pipeline.planning.settings import Settings
from renderer.report.document import EstimatedFigure
from renderer.report.estimate_document import EstimateDocument
from storage import place
from storage.work import work

FOLDER = "estimates"
FIGURES = ("seconds", "peak_memory_bytes", "gpu_bytes", "file_bytes", "texture_psnr_db", "pages_bytes")


def keep_estimate(work_folder: Path, settings: Settings, estimate: EstimateDocument) -> None:
    """Keep an estimate in the work folder that it was made in, under its settings."""
    path = _path(work_folder, settings)
    place.make_folder(path.parent)
    work.write_json(path, msgspec.to_builtins(estimate))


def known_estimate(work_folder: Path, settings: Settings) -> EstimateDocument | None:
    """The estimate that was made in a work folder for these settings."""
    path = _path(work_folder, settings)
    return msgspec.convert(work.read_json(path), EstimateDocument) if place.is_file(path) else None


def _path(work_folder: Path, settings: Settings) -> Path:
    text = json.dumps(asdict(settings), sort_keys=True)
    return work_folder / FOLDER / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.json"


def against(estimate: EstimateDocument | None, happened: dict[str, float | None]) -> dict[str, EstimatedFigure] | None:
    """By figure: value, low and high of the estimate, and what happened; None without an estimate."""
    if estimate is None:
        return None
    return {
        name: EstimatedFigure(found.value, found.low, found.high, had)
        for name in FIGURES
        if (found := getattr(estimate, name)) and (had := happened.get(name)) is not None
    }
