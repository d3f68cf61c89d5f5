"""Where the time of a frame goes: packed files of a laser scan at fewer points against that of all of them.

    python -m benchmarks.station_frames ALL.splatpress FEWER.splatpress... [--rounds 9] [--far-px 200]

Views: far, where the scan is so many pixels large, and none of it, the eye turned around: what a frame takes whatever it
shows. Frames are drawn in turns; told are the medians of their passes in ms, of their sum, and the ratio of sums to
those of all points, without what a frame of nothing takes besides.
"""

from __future__ import annotations

import argparse
import statistics
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.station_maps import looking
from renderer.splats.renderer import Renderer
from renderer.splats.scene import GpuScene
from renderer.splats.views import bulk_of
from storage.packed.packed import PackedFile, PackedScene
from storage.packed.schema import Camera


def far_view(scene: PackedScene, far_px: int) -> Camera:
    """As that of `benchmarks.station_maps`."""
    low, high = bulk_of(scene)
    middle = (low.min(axis=0) + high.max(axis=0)) / 2 + scene.header.origin
    size = float(np.linalg.norm(high.max(axis=0) - low.min(axis=0)))
    way = np.array([0.8, 0.0, 0.6])
    near = looking("far", middle + size * way, middle)
    return looking("far", middle + size * near.fx_px / far_px * way, middle)


def turned_around(view: Camera) -> Camera:
    right, down, forward = np.array(view.rotation)
    return replace(view, name="none of it", rotation=tuple(map(tuple, np.array([-right, down, -forward]).tolist())))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--far-px", type=int, default=200)
    options = parser.parse_args()
    renderer = Renderer()
    scenes = []
    for file in options.files:
        with PackedFile(file) as opened:
            scenes.append(opened.load())
    drawn = [GpuScene(scene, renderer.context) for scene in scenes]
    far = far_view(scenes[0], options.far_px)
    sums: dict[str, list[list[float]]] = {}
    for view in (far, turned_around(far)):
        passes = [[renderer.render(scene, view).pass_seconds for scene in drawn] for _ in range(options.rounds + 1)][1:]
        sums[view.name] = [[1e3 * sum(of.values()) for of in of_round] for of_round in passes]
        for i, file in enumerate(options.files):
            by_pass = {k: 1e3 * statistics.median(of_round[i][k] for of_round in passes) for k in passes[0][i]}
            ratio = statistics.median(of[0] / of[i] for of in sums[view.name])
            words = "  ".join(f"{name} {ms:6.2f}" for name, ms in by_pass.items())
            total = statistics.median(of[i] for of in sums[view.name])
            print(f"{view.name:11} {file.parent.name:18} {words}  sum {total:7.2f} ms  {ratio:5.1f}x", flush=True)
    nothing = [statistics.median(of) for of in zip(*sums["none of it"], strict=True)]
    for i, file in enumerate(options.files):
        ratio = statistics.median((of[0] - nothing[0]) / (of[i] - nothing[i]) for of in sums["far"])
        print(f"without what a frame of nothing takes: {file.parent.name:18} {ratio:5.1f}x")


if __name__ == "__main__":
    main()
