"""Far views of a packed file with levels: `python -m benchmarks.far_views PACKED [--size 1280x720] [--budget N]`.

From so many times the distance at which the scan fills the picture: splats drawn, processor seconds of a frame (medians
of three in turns) by default, with a budget of splats and of the finest level alone. Then a flight from near to far and
an eighth around the scan: how far a frame is, in levels of 255 on average over covered pixels, from the same view drawn
with the levels that the frame before had (`pop`), and from the frame before (`frames`). Last, where in the file its
coarsest level ends, which stands behind the header and the table of groups: what a first picture takes.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from renderer.splats.detail import FINEST, Detail
from renderer.splats.renderer import Picture, Renderer
from renderer.splats.scene import GpuScene
from renderer.splats.targets import USUAL
from renderer.splats.views import bulk_of, framed_views
from storage.packed.packed import PackedFile
from storage.packed.schema import GROUP, Camera

AWAY = (1, 2, 4, 8, 16, 32)
TURNS, FRAMES = 3, 150  # six seconds of flight


class Kept(GpuScene):
    """A scene whose shares can be kept from frame to frame."""

    keeps = False

    def show(self, view: Camera, detail: Detail) -> None:
        if not self.keeps:
            super().show(view, detail)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("packed", type=Path)
    parser.add_argument("--size", default="1280x720")
    parser.add_argument("--budget", type=int, default=500_000)
    options = parser.parse_args()
    size = tuple(map(int, options.size.split("x")))
    renderer = Renderer(antialias=USUAL)
    with PackedFile(options.packed) as packed:
        scene, table, header = packed.load(), packed.groups, packed.header
    gpu_scene = Kept(scene, renderer.context)
    print(f"{header.n_splats:,} splats of levels {header.levels}")
    low, high = bulk_of(scene)
    middle = (low.min(axis=0) + high.max(axis=0)) / 2 + header.origin
    (near,) = framed_views(scene, 1, size)
    print(f"{'away':>6}{'splats':>12}{'budget':>12}{'default s':>11}{'budget s':>10}{'finest s':>10}{'times':>8}")
    for away in AWAY:
        view = _seen_from(near, middle, away, 0.0)
        details = {"default": Detail(), "budget": Detail(most_splats=options.budget), "finest": FINEST}
        seconds: dict[str, list[float]] = {name: [] for name in details}
        n_drawn = {}
        for _ in range(TURNS + 1):
            for name, detail in details.items():
                seconds[name].append(_seconds(lambda d=detail: renderer.render(gpu_scene, view, detail=d)))  # noqa: B023
                n_drawn[name] = gpu_scene.n_chosen
        s = {name: float(np.median(all_[1:])) for name, all_ in seconds.items()}
        print(
            f"{away:6}{n_drawn['default']:12,}{n_drawn['budget']:12,}{s['default']:11.3f}{s['budget']:10.3f}"
            f"{s['finest']:10.3f}{s['finest'] / s['default']:8.1f}"
        )
    pops, moves, before = [], [], None
    for i in range(FRAMES):
        view = _seen_from(near, middle, 1.5 * (AWAY[-1] / 2) ** (i / (FRAMES - 1)), np.pi / 4 * i / (FRAMES - 1))
        if before is not None:
            gpu_scene.keeps = True
            with_old = renderer.render(gpu_scene, view)
            gpu_scene.keeps = False
        now = renderer.render(gpu_scene, view)
        if before is not None:
            pops.append(_apart(now, with_old))
            moves.append(_apart(now, before))
        before = now
    print(f"flight of {FRAMES} frames: pops {np.mean(pops):.2f}, most {np.max(pops):.2f} levels of 255; frames "
          f"{np.mean(moves):.2f}, most {np.max(moves):.2f}")  # fmt: skip
    n_coarsest = header.levels[0] // GROUP
    first = int((table.start + table.bytes)[:n_coarsest].max())
    whole = options.packed.stat().st_size
    print(f"first picture: the first {first:,} of {whole:,} bytes, {100 * first / whole:.2f} %")
    gpu_scene.release()


def _seen_from(near: Camera, middle: np.ndarray, away: float, turn: float) -> Camera:
    """The view from so many times as far, turned by an angle about the vertical of the picture."""
    rotation = np.array(near.rotation)
    s, c = np.sin(turn), np.cos(turn)
    turned = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ rotation
    local = rotation @ (np.array(near.centre) - middle)
    return replace(
        near, rotation=tuple(map(tuple, turned.tolist())), centre=tuple((middle + turned.T @ (away * local)).tolist())
    )


def _seconds(draw: Callable[[], Picture]) -> float:
    begun = time.process_time()
    draw()
    return time.process_time() - begun


def _apart(a: Picture, b: Picture) -> float:
    seen = a.coverage | b.coverage
    return float(np.abs(a.rgb[seen].astype(float) - b.rgb[seen]).mean()) if seen.any() else 0.0


if __name__ == "__main__":
    main()
