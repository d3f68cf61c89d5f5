"""Small scans for tests of the whole: a wavy photographed plane with some grain, and coloured points without photos."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from pipeline.execution.executors import SerialExecutor
from pipeline.planning.settings import settings_for
from services.cli.client import zip_folder
from services.processes.compress import compress
from tests.pipeline.execution.test_stage import Heard
from tests.pipeline.readers.workspace import write_photo, write_ply, write_workspace


def photo_scan(path: Path, n_side: int = 140, grain: int = 40, n_cameras: int = 3) -> Path:
    """A COLMAP workspace of n_side^2 points and some photos, two blocks of splats at the default size."""
    write_workspace(path, n_cameras=n_cameras, n_side=n_side, params=(400.0, 410.0, 160.0, 120.0), size_px=(320, 240))
    rng = np.random.default_rng(0)
    for photo in sorted((path / "images").iterdir()):
        pixels = oiio.ImageBuf(str(photo)).get_pixels(oiio.UINT8).astype(int)
        grains = np.kron(rng.integers(-grain, grain + 1, (60, 80, 3)), np.ones((4, 4, 1), int))
        write_photo(photo, np.clip(pixels + grains, 0, 255).astype(np.uint8))
    return path


def point_scan(path: Path, n: int = 3000) -> Path:
    """A PLY of coloured points on a ball."""
    rng = np.random.default_rng(1)
    normal = rng.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    write_ply(path, normal * 2, normal, ((normal + 1) * 127).astype(np.uint8))
    return path


def packed_by_compress(scan: Path, out: Path, options: dict) -> bytes:
    """What `splatpress compress --preset draft` packs, in this process."""
    compress(scan, out, settings_for("draft", **options), SerialExecutor(), Heard(), render=False)
    return (out / f"{scan.name}.splatpress").read_bytes()


def padded_scan(folder: Path, megabytes: int) -> Path:
    """A small scan as a .zip of about that size: what takes a while to upload, and none to compress."""
    zip_folder(photo_scan(folder / "plane", n_side=12), folder / "large.zip")
    with zipfile.ZipFile(folder / "large.zip", "a") as archive:
        archive.writestr("padding.bin", bytes(range(256)) * (megabytes << 12))
    return folder / "large.zip"
