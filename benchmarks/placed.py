"""Is a scan that was turned, moved and scaled compressed as well as the scan itself?

    python -m benchmarks.placed WORKSPACE [--preset draft] [--json]

Writes the COLMAP workspace anew for each similarity x -> scale * turn @ x + shift, points, normals and cameras alike,
and compresses it; prints PSNR and bytes and by how much they differ from those of the workspace as it stands. Other
seeds say how much of that is the luck of the draw. Its photographs must be undistorted already.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.execution.executors import SerialExecutor
from pipeline.planning.settings import settings_for
from pipeline.readers import open_scan
from services.processes.compress import compress
from tests.hard_cases.scans import STILL, Placed, write_points
from tests.pipeline.execution.test_stage import Heard

FIGURES = ("texture_psnr_db", "visible_psnr_db", "resampling_psnr_db", "bytes_per_splat")
FAR = (4.5e5, 5.4e6, 100.0)
ANGLES = ((10, 20, 30), (115, -40, 65), (-77, 13, 151))  # degrees about z, y and x
TURNS = [Rotation.from_euler("zyx", angles, degrees=True).as_matrix() for angles in ANGLES]
RUNS = {  # where, and the seed of all random choices
    "as it is": (STILL, 0),
    "another seed": (STILL, 1),
    "a third seed": (STILL, 2),
    "moved, 1e3": (Placed(np.eye(3), 1e3, FAR), 0),
    "turned": (Placed(TURNS[0]), 0),
    "turned, moved, 1e-3": (Placed(TURNS[1], 1e-3, FAR), 0),
    "turned, moved, 1e3": (Placed(TURNS[2], 1e3, FAR), 0),
}


def write_placed(workspace: Path, target: Path, placed: Placed) -> Path:
    """The workspace elsewhere: a text model, points of double precision, the photographs and visibility by links."""
    scan = open_scan(str(workspace))
    pieces = list(scan.pieces(1 << 20))
    position, normal, color = (
        np.concatenate([getattr(p, name) for p in pieces]) for name in ("position", "normal", "color")
    )
    (target / "sparse").mkdir(parents=True)
    cameras, images = [], []
    for i, camera in enumerate(scan.cameras, 1):
        rotation = np.array(camera.rotation) @ placed.turn.T
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        shift = -rotation @ placed.points(np.array([camera.centre]))[0]
        lens = camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px
        cameras.append(f"{i} PINHOLE {camera.width_px} {camera.height_px} {' '.join(map(repr, lens))}")
        images.append(f"{i} {' '.join(repr(float(v)) for v in (w, x, y, z, *shift))} {i} {camera.name}\n")
    (target / "sparse" / "cameras.txt").write_text("\n".join(cameras) + "\n")
    (target / "sparse" / "images.txt").write_text("\n".join(images) + "\n")
    (target / "sparse" / "points3D.txt").write_text("")
    for name in ("images", "fused.ply.vis"):
        (target / name).symlink_to((workspace / name).resolve())
    write_points(target / "fused.ply", placed.points(position), (normal @ placed.turn.T).astype(np.float32), color)
    return target


def measured(workspace: Path, placed: Placed, seed: int, preset: str) -> dict[str, float]:
    folder = Path(tempfile.mkdtemp())
    try:
        scan = write_placed(workspace, folder / "scan", placed)
        report = compress(
            scan, folder / "out", settings_for(preset, seed=seed), SerialExecutor(), Heard(), render=False
        )
    finally:
        shutil.rmtree(folder)
    return {name: (report["quality"] | report["sizes"])[name] for name in FIGURES}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--preset", default="draft")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    found = {}
    for name, (placed, seed) in RUNS.items():
        found[name] = measured(options.workspace, placed, seed, options.preset)
        if not options.json:
            still = found["as it is"]
            said = (f"{figure} {value:.3f} ({value - still[figure]:+.3f})" for figure, value in found[name].items())
            print(f"{name:20} {', '.join(said)}", flush=True)
    if options.json:
        print(json.dumps(found))


if __name__ == "__main__":
    main()
