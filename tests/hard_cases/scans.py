"""Scans that are built to be hard: points of any value, cameras of any sort, moved, turned and scaled at will."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.execution.executors import SerialExecutor
from pipeline.planning.settings import settings_for
from services.processes.compress import compress
from storage.packed.packed import SUFFIX, PackedFile, PackedScene
from tests.pipeline.execution.test_stage import Heard
from tests.pipeline.readers.workspace import write_photo, write_vis

QUICK = settings_for("draft", target_psnr_db=34.0, training_splats=1000, iterations=2)


@dataclass(frozen=True)
class Placed:
    """A similarity: x -> scale * turn @ x + shift."""

    turn: np.ndarray
    scale: float = 1.0
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def points(self, x: np.ndarray) -> np.ndarray:
        return self.scale * x @ self.turn.T + self.shift


STILL = Placed(np.eye(3))


def write_points(
    path: Path, position: np.ndarray, normal: np.ndarray | None = None, color: np.ndarray | None = None
) -> Path:
    """A binary PLY with coordinates of double precision."""
    columns = [(name, "<f8", "double") for name in "xyz"]
    values = list(np.asarray(position, float).T)
    if normal is not None:
        columns += [(name, "<f4", "float") for name in ("nx", "ny", "nz")]
        values += list(normal.T)
    if color is not None:
        columns += [(name, "u1", "uchar") for name in ("red", "green", "blue")]
        values += list(color.T)
    rows = np.empty(len(position), [(name, kind) for name, kind, _ in columns])
    for (name, _, _), column in zip(columns, values, strict=True):
        rows[name] = column
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property {kind} {name}" for name, _, kind in columns] + ["end_header", ""]
    path.write_bytes("\n".join(header).encode() + rows.tobytes())
    return path


def write_photographed(path: Path, position, normal, color, visible, cameras, photos) -> Path:
    """A COLMAP workspace in text; `cameras` are (fx, fy, cx, cy, world-to-camera rotation, centre)."""
    (path / "sparse").mkdir(parents=True)
    lines, images = [], []
    for i, ((fx, fy, cx, cy, rotation, centre), photo) in enumerate(zip(cameras, photos, strict=True)):
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        t = -np.asarray(rotation) @ centre
        lines.append(f"{i + 1} PINHOLE {photo.shape[1]} {photo.shape[0]} {fx!r} {fy!r} {cx!r} {cy!r}")
        images.append(" ".join(repr(float(n)) for n in (w, x, y, z, *t)).join([f"{i + 1} ", f" {i + 1} {i:04d}.png\n"]))
        write_photo(path / "images" / f"{i:04d}.png", photo)
    (path / "sparse" / "cameras.txt").write_text("\n".join(lines) + "\n")
    (path / "sparse" / "images.txt").write_text("\n".join(images) + "\n")
    (path / "sparse" / "points3D.txt").write_text("")
    write_points(path / "fused.ply", position, normal, color)
    if visible is not None:
        write_vis(path / "fused.ply.vis", visible)
    return path


def grained_photo(i: int, width: int = 160, height: int = 120) -> np.ndarray:
    rng = np.random.default_rng(i)
    fine = np.kron(rng.integers(-40, 41, (height // 4, width // 4, 3)), np.ones((4, 4, 1), int))
    y, x = np.mgrid[:height, :width]
    waves = 90 * np.stack([np.sin(x / 9 + i), np.cos(y / 11), np.sin((x + y) / 13)], axis=-1)
    return np.clip(128 + fine + waves, 0, 255).astype(np.uint8)


def photographed_wall(path: Path, placed: Placed = STILL, n_side: int = 22, order: np.ndarray | None = None) -> Path:
    """A wavy wall of n_side^2 points and two photographs of it."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-0.8, 0.8, n_side), np.linspace(-0.6, 0.6, n_side)))
    position = np.column_stack([x, y, 0.05 * np.sin(3 * x)])
    normal = np.column_stack([0.15 * np.cos(3 * x), 0 * x, -np.ones_like(x)])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    order = np.arange(len(x)) if order is None else order
    cameras = [
        (200.0, 205.0, 80.0, 60.0, placed.turn.T, placed.points(np.array([dx, 0.1 * dx, -2.6])[None])[0])
        for dx in (-0.3, 0.3)
    ]
    color = np.full((len(x), 3), 128, np.uint8)
    return write_photographed(
        path,
        placed.points(position)[order],
        (normal @ placed.turn.T)[order].astype(np.float32),
        color,
        ((0, 1),) * len(x),
        cameras,
        [grained_photo(i) for i in range(2)],
    )


def compressed(scan: Path, out: Path, settings=QUICK, render: bool = False) -> tuple[dict, Path]:
    """Its report and its packed file."""
    report = compress(scan, out, settings, SerialExecutor(), Heard(), render=render)
    return report, next(out.glob("*" + SUFFIX))


def scene_of_packed(path: Path) -> PackedScene:
    with PackedFile(path) as packed:
        return packed.load()


def arrays_of_packed(path: Path) -> dict[str, np.ndarray]:
    return dict(scene_of_packed(path).arrays)
