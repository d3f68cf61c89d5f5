"""What Gaussian exports lose on photographs that textured nothing: `python -m benchmarks.exports SCAN [--held-out 4 8]`.

Packs the scan without those photographs, draws the packed file and its Gaussians from their cameras, and compares both
with the photographs, over the pixels that the packed file covers; the last rows are of twelve Gaussians a splat (`export --textured`). `--sigma` and
`--opacity` try other Gaussians.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

from benchmarks.gaussian_pictures import picture
from benchmarks.patches import Silent
from pipeline.effects.exposure.photographs import read_photo
from pipeline.execution.executors import SerialExecutor
from pipeline.exports.cloud import cloud_of, samples_of
from pipeline.exports.gaussians import OPACITY, SIGMA_IN_RADII, gaussians_of
from pipeline.planning.settings import settings_for
from renderer.evaluate.compare import psnr_db
from renderer.splats.renderer import Renderer
from renderer.splats.scene import GpuScene
from services.flow.code import code
from services.flow.pack import pack
from services.flow.prepare import prepare
from services.flow.run import Run
from storage.packed.packed import PackedFile


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path)
    parser.add_argument("--held-out", type=int, nargs="+", default=[4, 8])
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--density", type=float, default=1.0)
    parser.add_argument("--sigma", type=float, nargs="+", default=[SIGMA_IN_RADII], help="in radii")
    parser.add_argument("--opacity", type=float, nargs="+", default=[OPACITY])
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
    gaussians, textured = gaussians_of(cloud), gaussians_of(samples_of(scene, cloud))
    for i in held_out:
        view, photo = scene.header.cameras[i], read_photo(prepared.photos, i)
        shown = renderer.render(gpu_scene, view)
        packed_db = psnr_db(shown.rgb, photo, shown.coverage)
        for sigma in options.sigma:
            for opacity in options.opacity:
                tried = replace(gaussians, sigma=gaussians.sigma * sigma / SIGMA_IN_RADII, opacity=opacity)
                rgb, _ = picture(tried, view)
                db = psnr_db(rgb, photo, shown.coverage)
                rows.append(
                    {"photo": view.name, "sigma": sigma, "opacity": opacity, "packed_db": packed_db, "gaussians_db": db}
                )
        rgb, _ = picture(textured, view)
        db = psnr_db(rgb, photo, shown.coverage)
        rows.append({"photo": view.name, "sigma": "textured", "packed_db": packed_db, "gaussians_db": db})
    return rows


if __name__ == "__main__":
    main()
