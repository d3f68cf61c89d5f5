"""What Gaussians lose on photographs that textured nothing: `python -m benchmarks.exports SCAN [--held-out 4 8]`.

Packs the scan without those photographs, draws the packed file and its Gaussians from their cameras, as they are
written by default and as `--samples` and `--fit` say, and compares both with the photographs, over the pixels that the
packed file covers. Colours are fitted to pictures of the packed file from the cameras of the other photographs. `--sigma` and `--opacity` try other Gaussians.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from itertools import product
from pathlib import Path
from time import perf_counter

from benchmarks.gaussian_pictures import picture
from benchmarks.patches import Silent
from pipeline.effects.exposure.photographs import read_photo
from pipeline.execution.executors import SerialExecutor
from pipeline.exports.cloud import cloud_of
from pipeline.exports.formats import AUTO, FIT_STEPS, GAUSSIANS, SAMPLES
from pipeline.exports.gaussians import OPACITY, SIGMA_IN_RADII, gaussians_of
from pipeline.planning.settings import settings_for
from renderer.evaluate.compare import psnr_db
from renderer.evaluate.own_colours import in_own_colours
from renderer.splats.renderer import Renderer
from renderer.splats.scene import GpuScene
from services.flow.code import code
from services.flow.pack import pack
from services.flow.prepare import prepare
from services.flow.run import Run
from services.processes.export import sampled
from storage.packed.packed import PackedFile


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path)
    parser.add_argument("--held-out", type=int, nargs="+", default=[4, 8])
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--density", type=float, default=1.0)
    parser.add_argument("--sigma", type=float, nargs="+", default=[SIGMA_IN_RADII], help="in radii")
    parser.add_argument("--opacity", type=float, nargs="+", default=[OPACITY])
    parser.add_argument("--samples", choices=SAMPLES, nargs="+", default=[AUTO, "1", "12"])
    parser.add_argument("--fit", type=int, nargs="+", default=[0, FIT_STEPS], help="steps")
    parser.add_argument("--work", type=Path, required=True, help="keep the stages' outputs and the packed file there")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = measure(options)
    for row in rows:
        print(
            json.dumps(row)
            if options.json
            else "  ".join(f"{k} {v if isinstance(v, str) else f'{v:.2f}'}" for k, v in row.items())
        )


def measure(options: argparse.Namespace) -> list[dict]:
    options.work.mkdir(parents=True, exist_ok=True)
    run = Run(options.work, SerialExecutor(), Silent())
    settings = settings_for(options.preset, density=options.density)
    held_out = tuple(options.held_out)
    prepared = prepare(run, options.scan, None, "", held_out, options.density)
    path = options.work / "held-out.splatpress"
    pack(run, prepared, code(run, prepared, settings), settings, options.scan.stem, path)
    with PackedFile(path) as packed:
        scene = packed.load()
    renderer = Renderer()
    gpu_scene = GpuScene(scene, renderer.context)
    cloud, rows = cloud_of(scene), []
    shown = {i: renderer.render(gpu_scene, scene.header.cameras[i]) for i in held_out}
    photos = {i: read_photo(prepared.photos, i) for i in held_out}
    for samples, sigma, opacity, fit in product(options.samples, options.sigma, options.opacity, options.fit):
        plain = gaussians_of(sampled(scene, cloud, GAUSSIANS, samples, fit)[0])
        tried = replace(plain, sigma=plain.sigma * sigma / SIGMA_IN_RADII, opacity=opacity)
        start = perf_counter()
        gaussians, _ = in_own_colours(scene, tried, fit) if fit else (tried, ())
        seconds = perf_counter() - start
        for i in held_out:
            view, mask = scene.header.cameras[i], shown[i].coverage
            rgb, _ = picture(gaussians, view)
            packed_db, db = psnr_db(shown[i].rgb, photos[i], mask), psnr_db(rgb, photos[i], mask)
            rows.append(
                {
                    "photo": view.name,
                    "samples": samples,
                    "fit": fit,
                    "sigma": sigma,
                    "opacity": opacity,
                    "gaussians": len(gaussians),
                    "fit_s": seconds,
                    "packed_db": packed_db,
                    "gaussians_db": db,
                    "lost_db": packed_db - db,
                }
            )
    return rows


if __name__ == "__main__":
    main()
