"""The photographs of a stage's folder, as they were taken, or brought to one light where they are looked at."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np

from pipeline.effects.exposure.light import relit
from storage.work import arrays, work

ONE_LIGHT = (
    "one_light.json"  # in the folder of the stage `exposure`: the ingest's name, and log_gain (n_photos, 3, N_TERMS)
)


def read_photo(folder: Path, index: int) -> np.ndarray:
    """Photograph `index` (h, w, 3) uint8."""
    fields = _one_light(folder)
    if fields is None:
        return arrays.read(folder, f"photo_{index}")
    height, width, _ = arrays.layout_of(fields[0], f"photo_{index}").shape
    return read_photo_window(folder, index, 0, 0, width, height)


def read_photo_window(folder: Path, index: int, left: int, top: int, right: int, bottom: int) -> np.ndarray:
    """Its rows top..bottom and columns left..right, which must lie in it: the same bytes as in the whole."""
    fields = _one_light(folder)
    source, name = folder if fields is None else fields[0], f"photo_{index}"
    pixels = arrays.read_window(source, name, top, bottom, left, right)
    if fields is None:
        return pixels
    height, width, _ = arrays.layout_of(source, name).shape
    return relit(pixels, fields[1][index], (left, top), (width, height))


def in_one_light(folder: Path, ingest: Path, log_gain: np.ndarray) -> None:
    """Make `folder`, beside the ingest's, stand for its photographs with their light times exp(log_gain)."""
    work.write_json(folder / ONE_LIGHT, {"ingest": ingest.name, "log_gain": log_gain.tolist()})


@functools.lru_cache(maxsize=16)
def _one_light(folder: Path) -> tuple[Path, np.ndarray] | None:
    """Where the photographs are as taken, and the fields of their gains; None for a folder that has its own."""
    if arrays.exists(folder, "photo_0"):
        return None
    told = work.read_json(folder / ONE_LIGHT)
    return folder.parent / told["ingest"], np.array(told["log_gain"])
