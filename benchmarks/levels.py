"""How near each coarser level of a packed file comes to the finest, seen from where its splats are two pixels wide.

    python -m benchmarks.levels PACKED [--views 4] [--size 640] [--antialias 2] [--bound] [--json]

Orbit views from as far as the median radius of a level's splats is a pixel, drawn as the renderer chooses (each group
by its own size, two pixels wide at most: `chosen`), and that level alone, whose larger splats are then more than two
pixels wide. PSNR and SSIM are of the pixels that both cover; `more` and `fewer` are the shares of the finest level's
pixels that are covered beside them, and that are not.

With `--bound` two rows more a level, of what no choice of splats changes: `itself`, the finest level's picture against
the same drawn four times as large and averaged in linear light, as far as it is true; and `sampled`, that picture as
splats show it that lie one a pixel, as a level's do there, each somewhere in its pixel, with just the colour that the
picture has there: neither a colour nor what hides what is wrong.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from pipeline.numerics.srgb import LINEAR_OF_LEVEL, levels_of_linear
from pipeline.splats.decoded import scene_radii
from renderer.evaluate.compare import psnr_of_error, ssim
from renderer.splats.detail import Detail
from renderer.splats.projection import larger
from renderer.splats.renderer import Picture, Renderer
from renderer.splats.scene import SHARES, GpuScene
from renderer.splats.targets import USUAL
from renderer.splats.views import bulk_of, orbit_views
from storage.packed.packed import PackedFile
from storage.packed.schema import GROUP, Camera

TIMES = 4  # as large, of a picture that is taken to be true


class Levels(GpuScene):
    """A scene of which one level is drawn, or with None what the view asks for."""

    level: int | None = None

    def show(self, view: Camera, detail: Detail) -> None:
        if self.level is None:
            return super().show(view, detail)
        groups = [-(-n // GROUP) for n in self.scene.header.levels]
        shares = np.repeat(np.arange(len(groups)) == self.level, groups).astype(np.float32)
        with self.context:
            self.buffers[SHARES].write(shares.tobytes())


@dataclass(frozen=True)
class Shown:
    rgb: np.ndarray  # (height, width, 3) uint8
    coverage: np.ndarray  # (height, width) bool


@dataclass
class Difference:
    """Of pictures to those of the finest level."""

    error: float = 0.0
    n: int = 0
    ssim: list[float] = field(default_factory=list)
    more: list[float] = field(default_factory=list)
    fewer: list[float] = field(default_factory=list)

    def add(self, found: Picture | Shown, fine: Picture) -> None:
        both, n_fine = found.coverage & fine.coverage, int(fine.coverage.sum())
        self.error += float(((found.rgb[both].astype(float) - fine.rgb[both]) ** 2).sum())
        self.n += 3 * int(both.sum())
        self.ssim.append(ssim(found.rgb, fine.rgb, both) or 0.0)
        self.more.append(int(found.coverage.sum() - both.sum()) / n_fine)
        self.fewer.append(1 - int(both.sum()) / n_fine)

    def row(self) -> dict[str, float]:
        means = {name: float(np.mean(getattr(self, name))) for name in ("ssim", "more", "fewer")}
        return {"psnr_db": psnr_of_error(self.error / self.n)} | means


def averaged(renderer: Renderer, gpu_scene: Levels, view: Camera) -> Shown:
    """The view as means of TIMES x TIMES pixels, of those that are covered."""
    large = renderer.render(gpu_scene, larger(view, TIMES))
    shape = view.height_px, TIMES, view.width_px, TIMES
    n = large.coverage.reshape(shape).sum(axis=(1, 3))
    light = (LINEAR_OF_LEVEL[large.rgb] * large.coverage[..., None]).reshape(*shape, 3).sum(axis=(1, 3))
    return Shown(_stored(light, n), n > 0)


def sampled(fine: Picture, rng: np.random.Generator) -> Shown:
    """A picture as a splat a pixel shows it, two pixels wide and somewhere in its pixel, with that pixel's colour."""
    height, width = fine.coverage.shape
    row, column = (rng.random((height, width)) - 0.5 for _ in range(2))
    own, light, weights = LINEAR_OF_LEVEL[fine.rgb], np.zeros((height, width, 3)), np.zeros((height, width))
    for down in (-1, 0, 1):
        for aside in (-1, 0, 1):
            d2 = np.roll((row - down) ** 2 + (column - aside) ** 2, (down, aside), (0, 1))
            weight = np.maximum(0, 1 - d2) * np.roll(fine.coverage, (down, aside), (0, 1))
            light += weight[..., None] * np.roll(own, (down, aside), (0, 1))
            weights += weight
    return Shown(_stored(light, weights), fine.coverage)


def _stored(light: np.ndarray, weight: np.ndarray) -> np.ndarray:
    return levels_of_linear(light / np.maximum(weight, 1e-9)[..., None])


def measured(packed: Path, n_views: int, side_px: int, bound: bool = False, antialias: int = USUAL) -> list[dict]:
    """Two rows a coarser level, the coarsest first, with `bound` four."""
    with PackedFile(packed) as opened:
        scene = opened.load()
    renderer = Renderer(antialias=antialias)
    gpu_scene = Levels(scene, renderer.context)
    radius, ends = scene_radii(scene), np.cumsum(scene.header.levels)
    low, high = bulk_of(scene)
    middle = (low.min(axis=0) + high.max(axis=0)) / 2 + scene.header.origin
    rows = []
    for level, end in enumerate(ends[:-1]):
        own = float(np.median(radius[end - scene.header.levels[level] : end]))
        found = {name: Difference() for name in ("chosen", "alone", *(("itself", "sampled") if bound else ()))}
        for view in orbit_views(scene, n_views, (side_px, side_px)):
            away = np.subtract(view.centre, middle)
            eye = middle + away / np.linalg.norm(away) * view.fx_px * own
            far = replace(view, centre=tuple(eye.tolist()))
            gpu_scene.level = len(ends) - 1
            fine = renderer.render(gpu_scene, far)
            if bound:
                found["itself"].add(averaged(renderer, gpu_scene, far), fine)
                found["sampled"].add(sampled(fine, np.random.default_rng(0)), fine)
            for way, drawn in (("chosen", None), ("alone", level)):
                gpu_scene.level = drawn
                found[way].add(renderer.render(gpu_scene, far), fine)
        rows += [{"splats": int(scene.header.levels[level]), "drawn": way} | d.row() for way, d in found.items()]
    gpu_scene.release()
    return rows


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("packed", type=Path)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--size", type=int, default=640, help="pixels to a side")
    parser.add_argument("--antialias", type=int, default=USUAL, help="as `render` has it")
    parser.add_argument("--bound", action="store_true", help="how near any splats of a level could come")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = measured(options.packed, options.views, options.size, options.bound, options.antialias)
    if options.json:
        print(json.dumps(rows))
        return
    print(f"{'splats':>12}  {'drawn':<8}{'PSNR':>8}{'SSIM':>9}{'more':>8}{'fewer':>8}")
    for row in rows:
        shares = "".join(f"{100 * row[k]:6.1f} %" for k in ("more", "fewer"))
        print(f"{row['splats']:12,}  {row['drawn']:<8}{row['psnr_db']:5.1f} dB{row['ssim']:9.3f}{shares}")


if __name__ == "__main__":
    main()
