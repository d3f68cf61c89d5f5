"""Packed files that more than one test of the renderer draws."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.execution.executors import SerialExecutor
from pipeline.planning.settings import settings_for
from services.processes.compress import compress
from storage.packed.schema import GROUP
from tests.pipeline.readers.workspace import write_ply
from tests.services.scans import Heard

N_LEVELLED = 17 * GROUP + 300


@pytest.fixture(scope="session")
def levelled_files(tmp_path_factory) -> dict[int, Path]:
    """A wavy surface of a metre without levels and with two, packed."""
    folder, rng = tmp_path_factory.mktemp("levelled"), np.random.default_rng(0)
    position = rng.uniform(0, 1, (N_LEVELLED, 3)).astype(np.float32)
    position[:, 2] = 0.02 * np.sin(20 * position[:, 0])
    wave = np.sin(30 * position[:, 0]) * np.cos(25 * position[:, 1])
    color = np.rint(127 + 100 * np.stack([wave, np.roll(wave, 1) * 0, -wave], axis=1)).astype(np.uint8)
    write_ply(folder / "scan.ply", position, np.tile(np.float32([0, 0, 1]), (N_LEVELLED, 1)), color)
    made = {}
    for levels in (0, 2):
        settings, out = settings_for("draft", levels=levels), folder / f"{levels}"
        compress(folder / "scan.ply", out, settings, SerialExecutor(), Heard(), render=False, work=folder / "work")
        made[levels] = next(out.glob("*.splatpress"))
    return made
