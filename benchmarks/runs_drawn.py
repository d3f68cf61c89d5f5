"""Runs against boxes as they are drawn, and what turned backs save: files of `compress --geometry runs`.

    python -m benchmarks.runs_drawn PACKED [PACKED ...] [--size 960x720] [--json]

The decoded cells of each file are exported and packed anew in boxes, with the same radius. Frames alternate: all runs decoded by the compute
shader, the runs drawn, and the boxes drawn. `ratio` is the median of the boxes' processor time, of all threads of llvmpipe, over that of the runs, above
1 where runs are faster: decoded once, when a file is loaded, as all that draws them does; `ratio_decoded_each_frame` has the decoding in every frame. Of six
views along the axes of the file: the share of splats that show their backs, of those that cones of groups of 8,192 leave out at once, of
those that faced the viewer and were left out, and how much the picture changes where all backs are left out.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.patches import Silent
from pipeline.execution.executors import SerialExecutor
from pipeline.geometry.normals import decode_normals
from pipeline.planning.settings import settings_for
from pipeline.splats.decoded import scene_bounds, scene_normal_codes, scene_positions
from renderer.evaluate.compare import psnr_db
from renderer.splats.renderer import Renderer
from renderer.splats.scene import DRAWS, GpuScene
from renderer.splats.views import framed_views, hides_backs
from services.processes.compress import compress
from services.processes.export import export
from storage.packed.packed import SUFFIX, PackedFile, PackedScene
from storage.packed.schema import GROUP, Camera

ROUNDS = 9
AWAY = 2.5  # times half of the scene's diagonal, of the six views


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("packed", type=Path, nargs="+")
    parser.add_argument("--size", default="960x720")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    rows = [_row(packed, (width, height)) for packed in options.packed]
    print(
        json.dumps(rows) if options.json else "\n\n".join("\n".join(f"{k:<22} {v}" for k, v in r.items()) for r in rows)
    )


def _row(packed: Path, size: tuple[int, int]) -> dict:
    scene, renderer = _loaded(packed), Renderer()
    with tempfile.TemporaryDirectory() as folder:
        boxes = _in_boxes(packed, scene, Path(folder))
    return {"file": packed.name, "splats": scene.header.n_splats, **_times(renderer, scene, boxes, size), **_backs(renderer, scene, size)}  # fmt: skip


def _loaded(packed: Path) -> PackedScene:
    with PackedFile(packed) as opened:
        return opened.load()


def _in_boxes(packed: Path, scene: PackedScene, folder: Path) -> PackedScene:
    cloud = folder / "cells.ply"
    export(packed, "ply", cloud)
    settings = settings_for("draft", geometry="boxes", radius=scene.header.radius, levels=0, effects="ellipsoids=off")
    compress(cloud, folder / "out", settings, SerialExecutor(), Silent(), render=False)
    made = _loaded(next((folder / "out").glob(f"*{SUFFIX}")))
    return PackedScene(replace(made.header, effects=scene.header.effects), made.arrays)  # lit as runs are


def _times(renderer: Renderer, runs: PackedScene, boxes: PackedScene, size: tuple[int, int]) -> dict:
    assert boxes.header.n_splats == runs.header.n_splats
    view = framed_views(runs, 1, size)[0]
    of_runs, of_boxes = (
        GpuScene(scene, renderer.context, front_only=hides_backs(scene, [view])) for scene in (runs, boxes)
    )
    taken: dict[str, list[float]] = {"decode": [], "runs": [], "boxes": []}
    for _ in range(ROUNDS):
        begun = time.process_time()
        with renderer.context as context:
            assert of_runs.runs is not None
            of_runs.runs.decode()
            context.finish()
        taken["decode"].append(time.process_time() - begun)
        for name, gpu_scene in (("runs", of_runs), ("boxes", of_boxes)):
            begun = time.process_time()
            renderer.render(gpu_scene, view)
            taken[name].append(time.process_time() - begun)
    of_runs.release()
    of_boxes.release()
    decode, drawn, other = (np.array(taken[name]) for name in ("decode", "runs", "boxes"))
    return {
        "decode_ms": float(1000 * np.median(decode)),
        "draw_runs_ms": float(1000 * np.median(drawn)),
        "draw_boxes_ms": float(1000 * np.median(other)),
        "ratio": float(np.median(other / drawn)),
        "ratios": [round(float(x), 2) for x in other / drawn],
        "ratio_decoded_each_frame": float(np.median(other / (decode + drawn))),
    }


def _backs(renderer: Renderer, scene: PackedScene, size: tuple[int, int]) -> dict:
    low, high = (side.min(axis=0) if i == 0 else side.max(axis=0) for i, side in enumerate(scene_bounds(scene)))
    middle, away = (low + high) / 2, AWAY * np.linalg.norm(high - low) / 2
    position, normal = scene_positions(scene), decode_normals(scene_normal_codes(scene))
    both, front = (GpuScene(scene, renderer.context, front_only=on) for on in (False, True))
    rows = []
    for axis in (*np.eye(3), *-np.eye(3)):
        view = _looking(middle + away * axis + scene.header.origin, axis, size)
        pictures = [renderer.render(gpu_scene, view) for gpu_scene in (both, front)]
        turned = ((position - middle - away * axis) * normal).sum(axis=1) > 0
        with renderer.context:
            draws = np.frombuffer(front.buffers[DRAWS].read(), np.uint32).reshape(-1, 5)[-scene.header.n_groups :]
        gone = np.repeat(draws[:, 0] == 0, GROUP)[: len(position)]
        mask = pictures[0].coverage | pictures[1].coverage
        rows.append((turned.mean(), gone.mean(), (gone & ~turned).mean(), psnr_db(pictures[1].rgb, pictures[0].rgb, mask),
                     (pictures[0].coverage != pictures[1].coverage).sum() / mask.sum()))  # fmt: skip
    both.release()
    front.release()
    views = framed_views(scene, 4, size)
    names = ("backs", "by_cones_of_groups", "facing_and_gone", "psnr_db", "outline_changed")
    return {"left_out_by_default": hides_backs(scene, views)} | {
        name: [round(float(x), 3) for x in column] for name, column in zip(names, zip(*rows))
    }


def _looking(eye: np.ndarray, axis: np.ndarray, size: tuple[int, int]) -> Camera:
    """A pinhole at `eye` that looks along minus `axis`, with the whole in its picture."""
    forward = -axis
    down = np.roll(np.abs(axis), 1)
    rotation = np.stack([np.cross(down, forward), down, forward])
    focal = 0.9 * AWAY * min(size) / 2
    width, height = size
    return Camera("axis", width, height, focal, focal, width / 2, height / 2, tuple(map(tuple, rotation.tolist())), tuple(eye.tolist()))  # fmt: skip


if __name__ == "__main__":
    main()
