"""What pages, feedback, ellipsoids and prediction cost a frame, pass by pass (2020, Figure 8):
`python -m benchmarks.page_passes PAGES PACKED [PACKED ...]`, files of one scan, as with discs and with ellipsoids.

All variants in turns, in one run, with all pages there; medians of ROUNDS. `predicted` is the frame of a flight: the
margin's fragments ask for pages too, and the small pictures of places are drawn on the CPU (`poses`).
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from pipeline.stages.pages.codecs import decoded
from renderer.residency.feedback import POSE
from renderer.residency.paths import pose_of
from renderer.residency.places import Screen
from renderer.residency.prediction import AHEAD_S, HALVING, MARGIN_SHARE, Motion, ahead
from renderer.residency.scene import scene_places
from renderer.splats.pages import GpuPages
from renderer.splats.renderer import Renderer
from renderer.splats.scene import GpuScene
from renderer.splats.views import view_of
from storage.packed.packed import PackedFile
from storage.pages.file import PageFile

SIZE, ROUNDS = (720, 480), 9
PASSES = ("cull", "visibility", "attribute", "resolve")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pages", type=Path)
    parser.add_argument("packed", type=Path, nargs="+")
    options = parser.parse_args()
    renderer, variants = Renderer(), {}
    with PageFile(options.pages) as file:
        texels = [
            decoded(file.header.codec, file.read(p), file.header.side_px, "a page") for p in range(file.layout.n_pages)
        ]
        for packed in options.packed:
            variants |= variants_of(renderer, file, texels, packed)
    taken: dict[str, list[dict[str, float]]] = {name: [] for name in variants}
    for turn in range(ROUNDS + 2):
        for name, draw in variants.items():
            seconds = draw()
            if turn >= 2:  # the first compile shaders and kernels
                taken[name].append(seconds)
    print(f"{'ms, medians':44}{''.join(f'{p:>11}' for p in (*PASSES, 'feedback', 'poses', 'frame'))}  to plain")
    plain = 0.0
    for name, rows in taken.items():
        median = {p: 1000 * float(np.median([row.get(p, 0.0) for row in rows])) for p in (*PASSES, "feedback", "poses")}
        frame = 1000 * float(np.median([sum(row.values()) for row in rows]))
        plain = frame if name.endswith("plain") else plain
        print(
            f"{name:44}{''.join(f'{ms:11.1f}' for ms in (*median.values(), frame))}  {frame / plain if plain else 0:.2f}"
        )


def variants_of(renderer: Renderer, file: PageFile, texels: list[np.ndarray], packed: Path) -> dict:
    """Functions that draw a frame and return the seconds of its passes, by what they are called."""
    with PackedFile(packed) as opened:
        scene = opened.load()
    places, label = scene_places(scene, 1, file.layout.page_px)
    gpu_scene = GpuScene(scene, renderer.context)
    cameras = scene.header.cameras
    pages = GpuPages(renderer.context, file.layout, file.header.border_px, cameras, label, 1 << 30)
    for page, rgb in enumerate(texels):
        pages.put(page, rgb)
    view = view_of(cameras[len(cameras) // 2], SIZE)
    x, y = (round(MARGIN_SHARE * side) for side in SIZE)
    wide = view.__class__(**{**view.__dict__, "width_px": SIZE[0] + 2 * x, "height_px": SIZE[1] + 2 * y,
                             "cx_px": view.cx_px + x, "cy_px": view.cy_px + y})  # fmt: skip
    screen, pose = Screen(*SIZE, view.fx_px), pose_of(view)
    still = Motion(np.zeros(3), np.array([0.0, 0.5, 0.0]))

    def draw(with_pages: bool, asks: bool = False, predicts: bool = False) -> dict[str, float]:
        gpu_scene.pages, pages.asks = pages if with_pages else None, asks
        seen, seconds = wide if predicts else view, {}
        pages.show_all(seen.width_px, seen.height_px, (x, y, x, y) if predicts else (0, 0, 0, 0))
        seconds |= renderer.render(gpu_scene, seen).pass_seconds
        if asks:
            begun = time.perf_counter()
            renderer.flatten_feedback(gpu_scene)
            pages.listed(2)
            renderer.context.finish()
            seconds["feedback"] = time.perf_counter() - begun
        if predicts:
            begun = time.perf_counter()
            places.seen(ahead(pose, still, AHEAD_S[0]), screen, 2 * HALVING).wanted(POSE)
            seconds["poses"] = time.perf_counter() - begun
        return seconds

    name = packed.parent.name
    return {
        f"{name}, atoms": lambda: draw(False),
        f"{name}, pages, plain": lambda: draw(True),
        f"{name}, pages, feedback": lambda: draw(True, True),
        f"{name}, pages, feedback, predicted": lambda: draw(True, True, True),
    }


if __name__ == "__main__":
    main()
