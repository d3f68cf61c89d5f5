"""The viewer on a large file with a budget, in Chromium without a graphics card: `python -m benchmarks.viewer PACKED
[--budget 500000]`.

Opens the file, waits until all that is wanted has come, and flies over it from one side to the other, `--steps` frames
in all. Says when the first picture was there and after how many bytes, the time of frames at rest and in flight, most
splats at once, GPU memory (the textures), the page's JavaScript heap, holes (pixels that the picture at rest covers and
the one in flight does not); how long the view of the whole takes to settle, between which frames of the browser, and
the PSNR of its picture before and after to the product's own of all splats of the finest level. `--mesa` draws by the
product's own driver, else SwiftShader does.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from renderer.evaluate.compare import psnr_db
from renderer.splats.detail import FINEST, Detail
from renderer.splats.renderer import Renderer
from renderer.splats.scene import GpuScene
from renderer.splats.views import bulk_of, orbit_views
from storage.packed.packed import PackedFile
from storage.packed.scene import PackedScene
from storage.packed.schema import Camera
from tests.services.chromium import MESA, SWIFTSHADER, Page
from tests.services.web.served import open_viewer, picture_of, serving, settled_picture, small

_FRAMES = """globalThis.frames = []; (function next(before) {
  requestAnimationFrame((now) => { if (!viewer.statistics().settled) frames.push(now - before), next(now); });
})(performance.now())"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("packed", type=Path)
    parser.add_argument("--budget", type=int, default=500_000)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480), metavar=("W", "H"))
    parser.add_argument("--steps", type=int, default=12)
    parser.add_argument("--mesa", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    found = measure(
        options.packed, options.budget, tuple(options.size), options.steps, MESA if options.mesa else SWIFTSHADER
    )
    print(json.dumps(found) if options.json else "\n".join(f"{name:28} {value}" for name, value in found.items()))


def measure(packed: Path, budget: int, size: tuple[int, int], steps: int, drawn_by: tuple[str, ...]) -> dict:
    """The figures by name."""
    with PackedFile(packed) as opened:
        scene = opened.load()
    (whole,) = orbit_views(scene, 1, size)
    with tempfile.TemporaryDirectory() as folder, serving(packed) as url:
        page = Page(Path(folder), drawn_by)
        try:
            small(page, *size)
            open_viewer(page, f"{url}?budget={budget}")
            first = _statistics(page)
            _stand(page, whole)
            rgb, covered = picture_of(page, whole, budget)
            flight = [_frame_in_flight(page, view, budget) for view in flight_over(scene, size, steps)]
            page.look(_FRAMES)
            begun = time.perf_counter()
            settled, settled_covered = settled_picture(page, whole)
            settling_s = time.perf_counter() - begun
            frames = sorted(json.loads(page.look("JSON.stringify(frames)")))
            heap = page.call("Runtime.getHeapUsage")["usedSize"]
            last = _statistics(page)
        finally:
            page.close()
    renderer = Renderer()
    gpu_scene = GpuScene(scene, renderer.context)
    compared = {}
    for name, detail in (("of all", FINEST), ("with this budget", Detail(1.0, budget))):
        picture = renderer.render(gpu_scene, whole, detail=detail)
        compared[f"db to the picture {name}"] = round(psnr_db(picture.rgb, rgb, covered & picture.coverage), 2)
        if detail is FINEST:
            both = settled_covered & picture.coverage
            compared["db to it when settled"] = round(psnr_db(picture.rgb, settled, both), 2)
            compared["holes before, of all pixels"] = round(float((picture.coverage & ~covered).mean()), 5)
            compared["coverage off by"] = round(float((settled_covered != picture.coverage).mean()), 5)
    return {
        "splats": scene.header.n_splats,
        "file_bytes": first["size"],
        "first_picture_s": round(first["times"]["picture"] / 1000, 2),
        "first_picture_bytes": first["first"]["bytes"],
        "first_picture_requests": first["first"]["requests"],
        "loaded_s": round(first["times"]["all"] / 1000, 2),
        "loaded_bytes": first["received"],
        "loaded_splats": first["splats"],
        "frame_ms": round(first["frameMs"]),
        "settling_s": round(settling_s, 1),
        "settling_frames_ms": [round(frames[int(q * (len(frames) - 1))]) for q in (0.5, 0.95, 1)],
        "settled_splats": last["splats"],
        **compared,
        "flight_frame_ms": [round(f["frameMs"]) for f in flight],
        "flight_most_splats": max(f["splats"] for f in flight),
        "flight_hole_pixels": [f["holes"] for f in flight],
        "gpu_bytes": last["gpuBytes"],
        "heap_bytes": heap,
        "received_bytes": last["received"],
    }


def flight_over(scene: PackedScene, size: tuple[int, int], steps: int) -> list[Camera]:
    """From a tenth of the whole's distance, across the bulk from side to side."""
    (far,) = orbit_views(scene, 1, size)
    low, high = bulk_of(scene)
    middle = (low.min(axis=0) + high.max(axis=0)) / 2 + scene.header.origin
    right = np.array(far.rotation[0])
    half = 0.35 * float(np.abs((high.max(axis=0) - low.min(axis=0)) @ np.abs(right)))
    eye = middle + 0.1 * (np.array(far.centre) - middle)
    return [replace(far, centre=tuple((eye + right * half * t).tolist())) for t in np.linspace(-1, 1, steps)]


def _frame_in_flight(page: Page, view: Camera, budget: int) -> dict:
    """What a frame shows at once, and what of it is a hole once all has come."""
    page.look(f"(viewer.complete = false, viewer.camera.stand({json.dumps(asdict(view))}), viewer.frame(1), null)")
    found = _statistics(page)
    _, at_once = picture_of(page, view, budget)
    _stand(page, view)
    _, settled = picture_of(page, view, budget)
    return found | {"holes": int((settled & ~at_once).sum())}


def _stand(page: Page, view: Camera) -> None:
    page.look(f"(viewer.complete = false, viewer.camera.stand({json.dumps(asdict(view))}), viewer.moved(), null)")
    page.until("viewer.complete && !viewer.queued")


def _statistics(page: Page) -> dict:
    return json.loads(page.look("JSON.stringify(viewer.statistics())"))


if __name__ == "__main__":
    main()
