"""Does the peak memory of a worker grow with the scan?  python -m benchmarks.memory [--json]

Compresses a synthetic photographed terrain of 0.2 and of 2 million points with two workers each and compares, stage by
stage, the peak resident memory of the worker that needed most. Terrain and photographs are made here: only their size
matters. Prints the ratio of the largest peaks; flat means at most 1.15.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np

from pipeline.execution.executors import DaskExecutor
from pipeline.planning.settings import settings_for
from services.processes.compress import compress

SIZES = (200_000, 2_000_000)
PHOTO_PX = (1536, 1024)
FOCAL_PX = 1200.0
HEIGHT = 10.0


class Silent:
    def begin(self, name, n_tasks): ...

    def advance(self, name, n_tasks, n_splats): ...

    def end(self, record): ...


def write_terrain(folder: Path, n_points: int) -> Path:
    """A COLMAP workspace of gentle hills seen by 12 cameras looking down; grainy photographs, no visibility lists but
    for the points' own."""
    import imageio.v3 as imageio

    rng = np.random.default_rng(0)
    (folder / "images").mkdir(parents=True)
    (folder / "sparse").mkdir()
    width, height = PHOTO_PX
    coarse = rng.integers(40, 216, (height // 4, width // 4, 3))
    picture = np.kron(coarse, np.ones((4, 4, 1), int)).astype(np.uint8)
    images = []
    for i, (x, y) in enumerate((x, y) for x in (-9, -3, 3, 9) for y in (-6, 0, 6)):
        imageio.imwrite(folder / "images" / f"{i:02d}.png", np.roll(picture, 97 * i, axis=1))
        images.append(f"{i + 1} 0 1 0 0 {-x} {y} {HEIGHT} 1 {i:02d}.png\n\n")  # half a turn about x: looking down
    (folder / "sparse" / "cameras.txt").write_text(
        f"1 PINHOLE {width} {height} {FOCAL_PX} {FOCAL_PX} {width / 2} {height / 2}\n"
    )
    (folder / "sparse" / "images.txt").write_text("".join(images))
    (folder / "sparse" / "points3D.txt").write_text("")
    _write_points(folder, n_points, rng)
    return folder


def _write_points(folder: Path, n_points: int, rng: np.random.Generator) -> None:
    record = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("color", "u1", 3)])
    properties = "".join(f"property float {p}\n" for p in ("x", "y", "z", "nx", "ny", "nz"))
    properties += "".join(f"property uchar {p}\n" for p in ("red", "green", "blue"))
    with open(folder / "fused.ply", "wb") as points, open(folder / "fused.ply.vis", "wb") as seen:
        points.write(
            f"ply\nformat binary_little_endian 1.0\nelement vertex {n_points}\n{properties}end_header\n".encode()
        )
        seen.write(np.uint64(n_points).tobytes())
        for start in range(0, n_points, 100_000):
            n = min(100_000, n_points - start)
            rows = np.zeros(n, record)
            xy = rng.uniform((-12, -9), (12, 9), (n, 2))
            rows["position"] = np.column_stack([xy, 0.3 * np.sin(xy[:, 0]) * np.cos(xy[:, 1])])
            rows["normal"] = (0, 0, 1)
            points.write(rows.tobytes())
            column = np.clip(np.round((xy[:, 0] + 9) / 6), 0, 3).astype(np.uint32)
            row = np.clip(np.round((xy[:, 1] + 6) / 6), 0, 2).astype(np.uint32)
            seen.write(np.column_stack([np.ones(n, np.uint32), column * 3 + row]).tobytes())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    peaks = {}
    for n_points in SIZES:
        with tempfile.TemporaryDirectory() as folder, DaskExecutor(2) as executor:
            scan = write_terrain(Path(folder) / "terrain", n_points)
            report = compress(scan, Path(folder) / "out", settings_for("balanced"), executor, Silent(), render=False)
        peaks[n_points] = {s["name"]: s["peak_rss_bytes"] for s in report["stages"]}
    ratio = max(peaks[SIZES[1]].values()) / max(peaks[SIZES[0]].values())
    if options.json:
        print(json.dumps({"peak_rss_bytes": peaks, "ratio": ratio}))
        return
    for name in peaks[SIZES[0]]:
        small, large = (peaks[n][name] / 2**20 for n in SIZES)
        print(f"{name:<16} {small:7.0f} MiB  {large:7.0f} MiB  {large / small:5.2f}")
    print(f"largest: {ratio:.3f} times")


if __name__ == "__main__":
    main()
