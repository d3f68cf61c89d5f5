"""Surfaces of volumes beside marching cubes: distances, and pictures side by side.

    python -m benchmarks.volume_surfaces VOLUME.nrrd=60 [...] [--pictures FOLDER] [--json]

Each is compressed (`draft`) in boxes and in runs. Distances are in voxels, from each splat as packed to points on the
triangles of marching cubes (scikit-image), which lie about .2 apart, and from their corners to the nearest splat.
Pictures have the surface in boxes, in runs, and marching cubes' triangles as a cloud of points under the same lamp, by
a depth buffer of their own.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from benchmarks.patches import Silent
from pipeline.execution.executors import SerialExecutor
from pipeline.planning.settings import settings_for
from pipeline.splats.decoded import scene_positions
from pipeline.volumes.open import open_volume
from renderer.effects.relighting import USUAL_LAMP, lamp
from renderer.pictures import save_picture
from renderer.splats.renderer import Renderer
from renderer.splats.scene import GpuScene
from renderer.splats.views import framed_views
from services.processes.compress import compress
from storage.packed.packed import SUFFIX, PackedFile, PackedScene
from storage.packed.schema import Camera

SIZE_PX = (640, 480)
FINER = 5  # points to a side of a triangle in its picture


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("volumes", nargs="+", metavar="VOLUME=ISO")
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = [row for text in options.volumes for row in _rows(text, options.pictures)]
    print(json.dumps(rows) if options.json else "\n".join(_text(row) for row in rows))


def _text(row: dict) -> str:
    return ", ".join(f"{k} {v:.3f}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items())


def _rows(text: str, pictures: Path | None) -> list[dict]:
    path, _, iso = text.partition("=")
    volume = open_volume(path)
    voxels = np.stack(list(volume.slices(lambda text: None))).transpose(2, 1, 0).astype(np.float32)
    corners, triangles, normals, _ = marching_cubes(voxels, float(iso))
    matrix = np.array(volume.directions)
    placed = corners @ matrix.T + volume.origin
    of_triangles = placed[triangles]
    mesh = cKDTree(np.einsum("sk,mkd->msd", _shares(FINER), of_triangles).reshape(-1, 3))
    rows, scenes = [], []
    for geometry in ("boxes", "runs"):
        scene = _made(path, iso, geometry)
        scenes.append(scene)
        position = scene_positions(scene) + scene.header.origin
        to, fro = (
            mesh.query(position)[0] / min(volume.spacing),
            cKDTree(position).query(placed)[0] / min(volume.spacing),
        )
        rows.append({"volume": Path(path).name, "iso": iso, "geometry": geometry, "splats": len(position),
                     "mean": float(to.mean()), "p99": float(np.quantile(to, 0.99)), "back_mean": float(fro.mean()),
                     "back_p99": float(np.quantile(fro, 0.99))})  # fmt: skip
    if pictures is not None:
        turned = normals @ np.linalg.inv(matrix)
        view = framed_views(scenes[0], 1, SIZE_PX)[0]
        drawn = [_picture(scene, view) for scene in scenes]
        cloud = _cloud(
            view, of_triangles, -turned[triangles] if _points_in(normals, corners, voxels) else turned[triangles]
        )
        save_picture(pictures / f"{Path(path).stem}-{iso}.png", np.concatenate([*drawn, cloud], axis=1))
    return rows


def _made(path: str, iso: str, geometry: str) -> PackedScene:
    with tempfile.TemporaryDirectory() as folder:
        settings = settings_for("draft", iso=f"{iso}=#d0c0a0", geometry=geometry)
        compress(Path(path), Path(folder) / "out", settings, SerialExecutor(), Silent(), render=False)
        with PackedFile(next((Path(folder) / "out").glob(f"*{SUFFIX}"))) as packed:
            return packed.load()


def _picture(scene: PackedScene, view: Camera) -> np.ndarray:
    renderer = Renderer()
    gpu_scene = GpuScene(scene, renderer.context)
    picture = renderer.render(gpu_scene, view)
    gpu_scene.release()
    return np.where(picture.coverage[..., None], picture.rgb, np.uint8(255))


def _points_in(normals: np.ndarray, corners: np.ndarray, voxels: np.ndarray) -> bool:
    """Whether normals of marching cubes look to higher values."""
    at = np.clip(np.rint(corners[::97] + 1.5 * normals[::97]).astype(int), 0, np.array(voxels.shape) - 1)
    back = np.clip(np.rint(corners[::97] - 1.5 * normals[::97]).astype(int), 0, np.array(voxels.shape) - 1)
    return float(voxels[tuple(at.T)].mean()) > float(voxels[tuple(back.T)].mean())


def _shares(n: int) -> np.ndarray:
    """Barycentric places (n (n + 1) / 2, 3) spread over a triangle."""
    a, b = np.meshgrid((np.arange(n) + 1 / 3) / n, (np.arange(n) + 1 / 3) / n)
    inside = a + b < 1
    return np.stack([1 - a[inside] - b[inside], a[inside], b[inside]], axis=1)


def _cloud(view: Camera, triangles: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Points on triangles (m, 3, 3) through a depth buffer, lit by the usual lamp."""
    share = _shares(FINER)
    position = np.einsum("sk,mkd->msd", share, triangles).reshape(-1, 3)
    normal = np.einsum("sk,mkd->msd", share, normals).reshape(-1, 3)
    rotation = np.array(view.rotation)
    camera, turned = (position - view.centre) @ rotation.T, normal @ rotation.T
    turned /= np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-9)
    light = lamp(*USUAL_LAMP)
    facing = np.where((turned * camera).sum(axis=1, keepdims=True) > 0, -turned, turned)
    bright = light.ambient + light.diffuse * np.maximum(facing @ np.array(light.towards), 0)
    x = (camera[:, 0] / camera[:, 2] * view.fx_px + view.cx_px).astype(int)
    y = (camera[:, 1] / camera[:, 2] * view.fy_px + view.cy_px).astype(int)
    inside = (x >= 0) & (x < view.width_px) & (y >= 0) & (y < view.height_px) & (camera[:, 2] > 0)
    order = np.flatnonzero(inside)[np.argsort(-camera[inside, 2])]  # the nearest last
    picture = np.full((view.height_px, view.width_px, 3), 255, np.uint8)
    linear = (np.array([208, 192, 160]) / 255.0) ** 2.2
    picture[y[order], x[order]] = np.rint(255 * (bright[order, None] * linear) ** (1 / 2.2)).astype(np.uint8)
    return picture


if __name__ == "__main__":
    main()
