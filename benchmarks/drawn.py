"""How long frames of packed files of one scan take beside each other: geometries, presets, levels.

    python -m benchmarks.drawn FIRST.splatpress OTHER.splatpress... [--size 800x600] [--views 4] [--rounds 9]

The files are drawn in turns from the same views, those of `render` without photographs. Told are medians of the
processor's time, of all threads that draw, each pass's time by the clock, and each round's ratio to the first file; and
how far the pictures are from the first file's.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from renderer.evaluate.compare import psnr_db
from renderer.splats.renderer import Renderer
from renderer.splats.scene import GpuScene
from renderer.splats.views import framed_views
from storage.packed.packed import PackedFile


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--size", default="800x600")
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=9)
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    renderer, scenes = Renderer(), []
    for file in options.files:
        with PackedFile(file) as opened:
            scenes.append(opened.load())
    drawn = [GpuScene(scene, renderer.context) for scene in scenes]
    views = framed_views(scenes[0], options.views, (width, height))
    shown = [[renderer.render(scene, view) for scene in drawn] for view in views]  # compiles, and is not timed
    seconds = np.empty((options.rounds, len(views), len(drawn)))
    passes: list[dict[str, list[float]]] = [{} for _ in drawn]
    for at in np.ndindex(*seconds.shape):
        begun = time.process_time()
        picture = renderer.render(drawn[at[2]], views[at[1]])
        seconds[at] = time.process_time() - begun
        for name, taken in picture.pass_seconds.items():
            passes[at[2]].setdefault(name, []).append(taken)
    frames = np.median(seconds, axis=1)
    for i, (file, scene) in enumerate(zip(options.files, drawn, strict=True)):
        ratio = frames[:, i] / frames[:, 0]
        each = ", ".join(f"{name} {1e3 * np.median(taken):.1f}" for name, taken in passes[i].items())
        far = [psnr_db(of[i].rgb, of[0].rgb, of[i].coverage | of[0].coverage) for of in shown]
        print(
            f"{file}: {1e3 * np.median(frames[:, i]):.1f} ms of the processor ({each} ms by the clock), "
            f"{np.median(ratio):.3f} of the first ({ratio.min():.2f} to {ratio.max():.2f}); "
            f"{scene.total_bytes / scene.scene.header.n_splats:.2f} bytes a splat; "
            f"{', '.join(f'{db:.1f}' for db in far)} dB from its pictures"
        )


if __name__ == "__main__":
    main()
