"""Runs or boxes for a scene with photographs, at as many bytes of the whole file: PSNR against the photograph in every
view.

    python -m benchmarks.geometries SCAN [--preset balanced] [--density D] [--work FOLDER] [--json]

The scan is compressed with `--geometry runs`, then in boxes two ways that make the file as large: all of its points at
a lower target of textures, and fewer points (`--density`) at the same target; each is searched until its bytes are
within TOLERANCE of those of runs. Pixels that any of the files covers are compared; one that a file leaves bare counts
as black.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.patches import Silent
from pipeline.execution.executors import DaskExecutor
from pipeline.planning.settings import settings_for
from pipeline.summaries import Photographs
from renderer.evaluate.close_ups import Variant, drawn
from renderer.evaluate.compare import psnr_db
from renderer.evaluate.previews import limited_view
from renderer.pictures import resized
from renderer.splats.renderer import Renderer
from services.processes.compress import compress
from storage.packed.packed import SUFFIX
from storage.work import arrays, work

TOLERANCE = 0.005  # of the bytes
ROUNDS = 5
SIDE_PX = 1536


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path)
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--density", type=float, default=1.0)
    parser.add_argument("--work", type=Path, help="keep the stages there")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.work) as folder, DaskExecutor(2) as executor:
        made = _Made(options.scan, Path(options.work or folder) / "work", Path(folder), options.preset, executor)
        files = _files(made, options.density)
        rows = compared({name: path for name, (path, _) in files.items()}, made.photos())
    found = {"files": {name: about for name, (_, about) in files.items()}, "views": rows}
    print(json.dumps(found) if options.json else _text(found))


class _Made:
    """Files of one scan."""

    def __init__(self, scan: Path, stages: Path, out: Path, preset: str, executor: DaskExecutor):
        self.scan, self.stages, self.out, self.preset, self.executor, self.n = scan, stages, out, preset, executor, 0

    def file(self, **knobs) -> tuple[Path, dict]:
        self.n += 1
        out = self.out / f"file_{self.n}"
        settings = settings_for(self.preset, **knobs)
        report = compress(self.scan, out, settings, self.executor, Silent(), render=False, work=self.stages)
        path = next(out.glob(f"*{SUFFIX}"))
        about = {"splats": report["splats"], "file_bytes": path.stat().st_size, "texture_psnr_db": report["quality"]["texture_psnr_db"],
                 "file_bytes_a_splat": path.stat().st_size / report["splats"], "gpu_bytes_a_splat": report["sizes"]["bytes_per_splat"],
                 "target_psnr_db": settings.target_psnr_db, "density": settings.density}  # fmt: skip
        return path, about

    def photos(self) -> Path:
        return next(self.stages.glob("ingest-*"))


def _files(made: _Made, density: float) -> dict[str, tuple[Path, dict]]:
    runs = made.file(geometry="runs", density=density)
    wanted = runs[1]["file_bytes"]
    target = settings_for(made.preset).target_psnr_db
    return {
        "runs": runs,
        "boxes, lower target": _searched(
            lambda x: made.file(geometry="boxes", density=density, target_psnr_db=x), wanted, target - 2, target
        ),
        "boxes, fewer points": _searched(
            lambda x: made.file(geometry="boxes", density=x), wanted, 0.75 * density, density
        ),
    }


def _searched(make: Callable[[float], tuple[Path, dict]], wanted: int, near: float, high: float) -> tuple[Path, dict]:
    """What `make` makes of a number with as many bytes as `wanted`, found by secants from `high`, which makes more, and
    `near`."""
    tried = []
    for x in (high, near):
        made = make(x)
        tried.append((x, made[1]["file_bytes"] - wanted))
    for _ in range(ROUNDS):
        (x0, f0), (x1, f1) = tried[-2:]
        if abs(f1) <= TOLERANCE * wanted or f0 == f1:
            break
        x = x1 - f1 * (x1 - x0) / (f1 - f0)
        made = make(x)
        tried.append((x, made[1]["file_bytes"] - wanted))
    return made


def compared(files: dict[str, Path], photos: Path) -> list[dict]:
    """PSNR of each file in each photograph's view."""
    renderer, cameras = Renderer(), work.summary(photos, Photographs).cameras
    views = [limited_view(camera, SIDE_PX) for camera in cameras]
    pictures = {}
    for name, path in files.items():
        with drawn(renderer, Variant(name, path)) as draw:
            pictures[name] = [draw(view) for view in views]
    rows = []
    for i, view in enumerate(views):
        photo = resized(arrays.read(photos, f"photo_{i}"), view.width_px, view.height_px)
        mask = np.any([found[i].coverage for found in pictures.values()], axis=0)
        row: dict = {"view": view.name}
        for name, found in pictures.items():
            shown = np.where(found[i].coverage[..., None], found[i].rgb, np.uint8(0))
            row[name] = psnr_db(shown, photo, mask)
        rows.append(row)
    return rows


def _text(found: dict) -> str:
    lines = [
        f"{name}: {f['splats']:,} splats, {f['file_bytes']:,} bytes, {f['file_bytes_a_splat']:.2f} a splat ({f['gpu_bytes_a_splat']:.2f} on a GPU), "
        f"target {f['target_psnr_db']:.2f} dB, density {f['density']:.3f}, textures {f['texture_psnr_db']:.2f} dB"
        for name, f in found["files"].items()
    ]
    names = list(found["files"])
    lines += [f"{'view':<16}" + "".join(f"{name:>22}" for name in names)]
    lines += [f"{row['view']:<16}" + "".join(f"{row[name]:>22.2f}" for name in names) for row in found["views"]]
    means = {name: np.mean([row[name] for row in found["views"]]) for name in names}
    return "\n".join([*lines, f"{'mean':<16}" + "".join(f"{means[name]:>22.2f}" for name in names)])


if __name__ == "__main__":
    main()
